"""What each command of the shell does: one module per command, of the same name."""
