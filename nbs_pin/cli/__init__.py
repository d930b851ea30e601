"""The command line `nbs-pin`.

This file imports almost nothing, so that Ctrl-C and SIGTERM are handled from the first millisecond. `shell.py` reads
the arguments, one module per command has its options, and `nbs_pin.commands` does the work.
"""

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from nbs_pin.cli.exit_codes import NO_PROMISE, SIGNALLED

__all__ = ["COMMANDS", "NO_PROMISE", "main", "parse"]

_HANDLED = (signal.SIGINT, signal.SIGTERM)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `nbs-pin` with these arguments, or the shell's, and return the exit code.

    It is 0 for success, 2 for bad input (one sentence on stderr), 3 if `certify` gives no promise (refused, or a
    condition fails) or `verify` does not confirm one, 4 if the guard stopped `run` or a row of `faults` fails, 130
    after Ctrl-C, 143 after SIGTERM.
    """
    arguments, alone = list(sys.argv[1:] if argv is None else argv), argv is None
    if threading.current_thread() is not threading.main_thread():  # only the main thread can handle signals
        return _shell().run(arguments, [], lambda: None)
    stops: list[int] = []

    def stop(number: int, _: Any) -> None:
        stops.append(SIGNALLED + number)
        raise KeyboardInterrupt

    # While modules are imported an exception could be swallowed or reappear as another one, and nothing is to be kept.
    previous = _handle(_leave if alone else stop)

    def begin() -> None:
        if alone:
            gc.freeze()
            gc.enable()
        _handle(stop)

    try:
        if alone:
            gc.disable()  # what modules define is kept, and looking through it takes a fifth of the import
        code: int = _shell().run(arguments, stops, begin)
        if alone and stops:
            # Where the interrupt met an exec of text, as dataclasses make it, the interpreter would end by the signal.
            sys.stdout.flush()
            os._exit(code)
        return code
    except KeyboardInterrupt:  # in the moments that `run` does not cover
        code = stops[0] if stops else SIGNALLED + signal.SIGINT
        if alone:
            _leave(code - SIGNALLED, None)
        return code
    finally:
        for number, handler in previous.items():
            signal.signal(number, _leave if alone else handler)


def _handle(handler: Callable[[int, Any], None]) -> dict[signal.Signals, Any]:
    """Let the handler receive the signals; returns those before it."""
    return {number: signal.signal(number, handler) for number in _HANDLED}


def _leave(number: int, _: Any) -> None:
    """End the process at once: nothing has been done yet, or all has been written."""
    clear = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""  # a spinner that hides the cursor may be shown
    os.write(2, f"{clear}nbs-pin: interrupted.\n".encode())
    os._exit(SIGNALLED + number)


def _shell() -> Any:
    return import_module("nbs_pin.cli.shell")


def __getattr__(name: str) -> Any:
    """COMMANDS and parse of `shell.py`."""
    if name in __all__:
        return getattr(_shell(), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
