"""Messages of type JointState in bags of ROS: *.bag of ROS 1, *.db3 and *.mcap of ROS 2."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError, MissingExtra, NbsPinError

BAGS = (".bag", ".db3", ".mcap")
"""Ends of the names of bags."""
STATES = "sensor_msgs/msg/JointState"
"""The type of messages that are read."""
MEASURED = "/joint_states"
"""The topic of what an arm measures, by the custom of ROS; others have what was asked of it."""
_PARTS = {"q": "position", "v": "velocity", "tau": "effort"}


class Bag(NamedTuple):
    """The states in a bag, by the names that `columns_of_arrays` takes, and notes on them."""

    arrays: dict[str, np.ndarray]
    notes: tuple[str, ...]


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The reader of rosbags of a bag; whatever it raises is a FileFormatError.

    Raises:
        MissingExtra: If the extra `logs` is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{path} needs a reader of bags: pip install 'nbs-pin[logs]'.") from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except NbsPinError:
        raise
    except Exception as error:  # damaged bags raise errors of many libraries
        raise FileFormatError(f"{path}: not an intact bag ({type(error).__name__}: {error!s:.200}).") from error


def read_bag(path: Path, topic: str | None) -> Bag:
    """The joint states in a bag, t in [s] from the first.

    Raises:
        MissingExtra: If the extra `logs` is not installed.
        FileFormatError: If the bag is damaged, or has no such messages.
        ArgumentError: If it has them under several topics, none of them /joint_states, and none of these is given.
    """
    with opened(path) as reader:
        found = {connection.topic for connection in reader.connections if connection.msgtype == STATES}
        name = _topic(path, sorted(found), sorted({c.topic for c in reader.connections}), topic)
        wanted = [connection for connection in reader.connections if connection.topic == name]
        states = [
            (stamp, reader.deserialize(raw, connection.msgtype))
            for connection, stamp, raw in reader.messages(connections=wanted)
        ]
    if not states:
        raise FileFormatError(f"{path}: no message under {name}; record more.")
    return _arrays(path, states)


def _topic(path: Path, found: list[str], all_topics: list[str], topic: str | None) -> str:
    """The topic to read."""
    if topic is not None and topic not in found:
        raise ArgumentError(f"columns has topic={topic}, and {path} joint states under {', '.join(found) or 'none'}.")
    if not found:
        raise FileFormatError(
            f"{path}: no messages of type JointState among {', '.join(all_topics):.300}; record them."
        )
    if topic is None and MEASURED in found:
        return MEASURED
    if topic is None and len(found) > 1:
        choice = option("columns", {"topic": found[0]})
        raise ArgumentError(f"{path} has joint states under {', '.join(found)}; choose one, as in {choice}.")
    return found[0] if topic is None else topic


def _arrays(path: Path, states: list[tuple[int, Any]]) -> Bag:
    """The arrays of the messages that have the joints of most; others are left out with a note."""
    usual = Counter(frozenset(state.name) for _, state in states).most_common(1)[0][0]
    kept = [(stamp, state) for stamp, state in states if frozenset(state.name) == usual]
    names = list(kept[0][1].name)
    stated = [(1_000_000_000 * s.header.stamp.sec + s.header.stamp.nanosec) or stamp for stamp, s in kept]
    arrays: dict[str, np.ndarray] = {
        "t": (np.array(stated, dtype=np.int64) - stated[0]) / 1e9, "joint_names": np.array(names)
    }  # fmt: skip
    for quantity, part in _PARTS.items():
        if all(len(getattr(state, part)) == len(names) for _, state in kept):
            rows = [dict(zip(state.name, getattr(state, part), strict=True)) for _, state in kept]
            arrays[quantity] = np.array([[row[name] for name in names] for row in rows], dtype=float)
    absent = [part for quantity, part in _PARTS.items() if quantity != "v" and quantity not in arrays]
    if absent:
        raise FileFormatError(f"{path}: not all joint states have {absent[0]}; record it for each joint.")
    left = len(states) - len(kept)
    return Bag(arrays, (f"messages of other joints are left out, {left} of {len(states)}",) if left else ())
