"""The process of one entrant on one arm: it is given tasks one by one, and may be ended at any time.

Run as `python -m nbs_pin.benchmarks.entrant_process SOCKET`. What the entrant prints goes nowhere.
"""

import os
import signal
import sys
import threading
from dataclasses import asdict
from multiprocessing.connection import Connection
from typing import Any

from nbs_pin.base.exceptions import NbsPinError
from nbs_pin.benchmarks.challenge_tasks import course_of
from nbs_pin.benchmarks.challenge_trial import figures_of, run_task
from nbs_pin.benchmarks.entrants import Entrant

_GRACE = 5.0  # beyond its limit before a process ends itself, should nobody be left to end it [s]


def main(socket: int) -> None:
    """Answer the requests of the other end until it is closed."""
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with Connection(socket) as parent:
        about = parent.recv()
        signal.alarm(int(about["limit"] + _GRACE))
        work = _prepared(about)
        signal.alarm(0)
        parent.send({})
        while True:
            try:
                request = parent.recv()
            except EOFError:
                return
            signal.alarm(int(request["limit"] + _GRACE))
            answer = _answered(work, request)
            signal.alarm(0)
            parent.send(answer)


def _end_with_parent() -> None:
    """The other end holds standard input open for as long as it lives; the session ends with it, children included."""
    sys.stdin.buffer.read()
    os.killpg(0, signal.SIGKILL)


def _prepared(about: dict[str, Any]) -> Any:
    """What answers a motion and a condition; a fault of the entrant is told with every answer."""
    course, entrant = course_of(about["arm"], about["seed"]), Entrant(about["entrant"])
    try:
        if about["kind"] == "promise":
            promise = entrant.promise()

            def promised(motion: str, condition: str) -> dict[str, Any]:
                bound = promise(course.task(motion, condition))
                return {"promise": None if bound is None else bound.tolist()}

            return promised
        make = entrant.maker()
        if entrant.is_ours:
            make(course.robot)  # once for all runs, and within the limit of the start
    except NbsPinError as error:
        fault = error

        def failed(motion: str, condition: str) -> dict[str, Any]:
            raise fault

        return failed

    def judged(motion: str, condition: str) -> dict[str, Any]:
        run = run_task(make(course.robot), course, motion, condition)
        return asdict(figures_of(run, course.robot))

    return judged


def _answered(work: Any, request: dict[str, Any]) -> dict[str, Any]:
    try:
        return {"result": work(request["motion"], request["condition"])}
    except NbsPinError as error:
        said = str(error)
    except (Exception, SystemExit) as error:  # whatever an entrant raises costs only itself
        said = f"{type(error).__name__}: {error!s:.300}"
    return {"failure": said.encode(errors="replace").decode()}  # names of files may be no text


if __name__ == "__main__":
    main(int(sys.argv[1]))
