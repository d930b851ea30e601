"""Exit codes of `nbs-pin`; 0 is success."""

BAD_INPUT = 2
"""One sentence on stderr says what to correct."""
NO_PROMISE = 3
"""`certify` gives no promise, or `verify` does not confirm one."""
STOPPED = 4
"""`run` was stopped by the guard, or a row of `faults` is not passed."""
SIGNALLED = 128
"""Plus the number of the signal: 130 after Ctrl-C, 143 after SIGTERM."""
