"""The work of the shell commands: one module per command, of the same name."""
