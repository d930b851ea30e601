"""Runs as MCAP: a message of ROS 2 for each instant and topic, in CDR with its schema, in chunks packed by zstd."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nbs_pin.base.exceptions import FileFormatError, MissingExtra
from nbs_pin.base.files import replaced_together
from nbs_pin.identification.log_bags import STATES, opened

DESCRIPTION, FACTS = "/robot_description", "/run"
"""Topics of texts: the URDF, and what else a run has, as JSON."""
PARTS = ("position", "velocity", "effort")
"""The arrays of a JointState."""
_TEXT = "std_msgs/msg/String"
_MARKS = (np.uint64(0xFFEFFFFFFFFFFFFF) - np.arange(len(PARTS), dtype=np.uint64)).view(np.float64)
"""Numbers whose bytes no text in UTF-8 has, to find the places of numbers in a message."""
_BLOCK = 4096
"""Rows whose messages are made at once."""


class Topic(NamedTuple):
    """The messages of a topic, one for each row."""

    names: Sequence[str]
    parts: Mapping[str, Float[np.ndarray, "rows n"]]
    """By `PARTS`; arrays that are left out are empty in the messages."""


def write_bag(
    path: Path, stamps: Int[np.ndarray, " rows"], topics: Mapping[str, Topic], texts: Mapping[str, str]
) -> None:
    """Write the topics, at the times in [ns], and the texts at the first of them to one MCAP file, atomically.

    Raises:
        MissingExtra: If the extra `logs` is not installed.
    """
    try:
        from rosbags import rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{path} needs a writer of bags: pip install 'nbs-pin[logs]'.") from error
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    text = store.types[_TEXT]
    with replaced_together(path.parent, [path.name]) as draft:
        writer = rosbag2.Writer(draft / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        with writer:
            for name, content in texts.items():
                sent = writer.add_connection(name, _TEXT, typestore=store, offered_qos_profiles=[_latched()])
                writer.write(sent, int(stamps[0]), store.serialize_cdr(text(content), _TEXT))
            connections = [writer.add_connection(name, STATES, typestore=store) for name in topics]
            messages = [_messages(store, stamps, topic) for topic in topics.values()]
            for stamp, *row in zip(stamps.tolist(), *messages, strict=True):
                for connection, message in zip(connections, row, strict=True):
                    writer.write(connection, stamp, message)
        (draft / "bag" / "bag.mcap").replace(draft / path.name)


def _messages(store: Any, stamps: Int[np.ndarray, " rows"], topic: Topic) -> Iterator[memoryview]:
    """The messages of a topic: all are as long as the first, so the numbers of each are put where it has them."""
    kinds = (STATES, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    state, header, time = (store.types[kind] for kind in kinds)
    marks = {
        part: np.full(len(topic.names) if part in topic.parts else 0, mark)
        for part, mark in zip(PARTS, _MARKS, strict=True)
    }
    first = bytes(store.serialize_cdr(state(header(time(0, 0), ""), list(topic.names), **marks), STATES))
    places = {part: first.index(marks[part].tobytes()) for part in topic.parts}
    for begin in range(0, len(stamps), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        at = stamps[block]
        rows = np.tile(np.frombuffer(first, np.uint8), (len(at), 1))
        rows[:, 4:12] = np.column_stack([at // 10**9, at % 10**9]).astype("<u4").view(np.uint8)  # after the encoding
        for part, place in places.items():
            numbers = np.ascontiguousarray(topic.parts[part][block], "<f8").view(np.uint8)
            rows[:, place : place + numbers.shape[1]] = numbers
        yield from (row.data for row in rows)


def _latched() -> Any:
    """The quality of service of what is sent once, also to those that come later."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    ever = QosTime(2147483647, 4294967295)
    return Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ever, ever,
               QosLiveliness.AUTOMATIC, ever, False)  # fmt: skip


def instants(stamps: Int[np.ndarray, " rows"], period: float, begins: float) -> Float[np.ndarray, " rows"]:
    """The times of stamps [s]: multiples of the period, which are not all whole nanoseconds, where they are near."""
    t = stamps / 1e9 + begins
    multiples = period * np.round(t / period)
    return np.where(np.abs(multiples - t) < 1e-9, multiples, t)


def read_bag(
    path: Path, topics: Collection[str]
) -> tuple[dict[str, tuple[Int[np.ndarray, " rows"], Topic]], dict[str, str]]:
    """Of the topics of a bag, times in [ns] and joint states, and the texts that were sent first, by topic.

    Raises:
        MissingExtra: If the extra `logs` is not installed.
        FileFormatError: If the bag is damaged, or the names or sizes in a topic change.
    """
    with opened(path) as reader:
        wanted = [c for c in reader.connections if c.msgtype in (STATES, _TEXT) and c.topic in topics]
        found: dict[str, list[tuple[int, Any]]] = {connection.topic: [] for connection in wanted}
        for connection, stamp, raw in reader.messages(connections=wanted):
            found[connection.topic].append((stamp, reader.deserialize(raw, connection.msgtype)))
        of_states = {connection.topic for connection in wanted if connection.msgtype == STATES}
    sent = {topic: messages for topic, messages in found.items() if messages}
    texts = {topic: str(messages[0][1].data) for topic, messages in sent.items() if topic not in of_states}
    return {topic: _rows(path, topic, messages) for topic, messages in sent.items() if topic in of_states}, texts


def _rows(path: Path, name: str, messages: list[tuple[int, Any]]) -> tuple[Int[np.ndarray, " rows"], Topic]:
    """Times and arrays of the messages of a topic."""
    names = messages[0][1].name
    parts = {part: [getattr(state, part) for _, state in messages] for part in PARTS}
    sizes = {len(x) for rows in parts.values() for x in rows}
    alike = all(len({len(x) for x in rows}) == 1 for rows in parts.values())
    if not alike or not sizes <= {0, len(names)} or any(state.name != names for _, state in messages):
        raise FileFormatError(f"{path}: the joints in {name} change; export the run again.")
    stamps = np.array([stamp for stamp, _ in messages], dtype=np.int64)
    return stamps, Topic(names, {part: np.array(rows, dtype=float) for part, rows in parts.items() if len(rows[0])})
