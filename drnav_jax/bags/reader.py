"""Messages of a rosbag: ROS 1 `.bag` files and ROS 2 folders (sqlite3, mcap), through the `rosbags` library.

A message's time is the stamp of its header; where that is zero or missing, the time of its recording.
"""

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

_MEND = "if the recording was cut off, mend it with `rosbag reindex` (ROS 1) or `ros2 bag reindex`"


class Message(NamedTuple):
    """One message, as `rosbags` deserialises it."""

    topic: str
    time: int  # [ns]
    content: Any


class Bag(NamedTuple):
    """An open bag; valid inside `opened`."""

    path: Path
    kinds: dict[str, str]  # topic -> type, such as sensor_msgs/msg/Image
    counts: dict[str, int]  # topic -> number of messages
    reader: Any


def _absent(bag: Path) -> str:
    if not bag.exists():
        return "it is not there"
    if bag.is_dir() and not (bag / "metadata.yaml").is_file():
        return "the folder has no metadata.yaml: give the one that `ros2 bag record` wrote, or run `ros2 bag reindex`"
    return ""


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator[Bag]:
    """Open a bag.

    Args:
        path: `.bag` file, or the folder with metadata.yaml.

    Raises:
        FileNotFoundError: If there is no bag.
        ValueError: If it is broken, or stored in a way that `rosbags` does not read.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    path = Path(path)
    if missing := _absent(path):
        raise FileNotFoundError(f"no bag at {path}: {missing}.")
    try:
        # The types of a bag that brings no definitions: those of the sensors have not changed since ROS 2 began.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except Exception as error:  # what a broken file raises depends on where it breaks
        raise ValueError(
            f"{path} cannot be read as a rosbag ({_said(error)}): {_MEND}; topics of odd types can be left out with "
            "`rosbags-convert`."
        ) from error
    try:
        topics = reader.topics
        yield Bag(
            path, {name: t.msgtype or "" for name, t in topics.items()}, {n: t.msgcount for n, t in topics.items()}, reader
        )
    finally:
        reader.close()


def _said(error: Exception) -> str:
    """What an error says, on one line that is not too long."""
    return " ".join(str(error).split())[:160] or type(error).__name__


def _time(content: Any, recorded: int) -> int:
    header = getattr(content, "header", None)
    stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
    return stamp or recorded


def messages(bag: Bag, topics: Collection[str]) -> Iterator[Message]:
    """Messages of some topics in the order of their recording; of no topic none.

    Args:
        bag: From `opened`.
        topics: Their names.

    Raises:
        ValueError: If the bag is broken further on.
    """
    wanted = [c for c in bag.reader.connections if c.topic in topics]
    if not wanted:
        return
    stream = bag.reader.messages(connections=wanted)
    while True:
        try:
            connection, recorded, raw = next(stream)
            content = bag.reader.deserialize(raw, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:  # as above
            raise ValueError(f"{bag.path} is broken ({_said(error)}): {_MEND}, or record it again.") from error
        yield Message(connection.topic, _time(content, recorded), content)


def listing(bag: Bag) -> str:
    """Topics and types as text, for errors."""
    return ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.kinds.items())) or "no topics"


def chosen(bag: Bag, wanted: str | None, kinds: Collection[str], what: str) -> str | None:
    """The topic for a sensor; None if the bag has none.

    Args:
        bag: From `opened`.
        wanted: Its name; None = the only one of the types.
        kinds: Types that can be read.
        what: The sensor, in words.

    Raises:
        ValueError: If the topic is missing, empty or of another type, or if there are several.
    """
    if wanted is None:
        found = [name for name, kind in bag.kinds.items() if kind in kinds and bag.counts[name]]
        if len(found) > 1:
            raise ValueError(f"{bag.path} has several topics for {what}, {', '.join(sorted(found))}: name one of them.")
        return found[0] if found else None
    if wanted not in bag.kinds:
        raise ValueError(f"{bag.path} has no topic {wanted} for {what}; it has {listing(bag)}.")
    if bag.kinds[wanted] not in kinds:
        raise ValueError(
            f"{wanted} is of type {bag.kinds[wanted]}, which is no {what}: name a topic of type "
            f"{' or '.join(sorted(kinds))}."
        )
    if not bag.counts[wanted]:
        raise ValueError(f"{bag.path} holds no message on {wanted}: was the {what} running?")
    return wanted
