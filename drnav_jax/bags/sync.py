"""Approximate time matching: to each message of one topic the nearest in time of every other.

    partner(t) = argmin_m |t_m - t|  over the messages of a topic, if that is <= tolerance; else none       (1)

Streams: no more is held than `PATIENCE` of messages. Stamps of one topic must not fall.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

from drnav_jax.bags.reader import Message

PATIENCE = 2_000_000_000  # [ns] how long a message may be recorded after others of its time


def _nearest(held: Iterable[Message], time: int, tolerance: int) -> Message | None:
    found = min(held, key=lambda m: abs(m.time - time), default=None)
    return found if found is not None and abs(found.time - time) <= tolerance else None


def matched(
    stream: Iterable[Message], reference: str, others: Sequence[str], tolerance: int
) -> Iterator[tuple[Message, dict[str, Message | None]]]:
    """Eq. 1 for each message of `reference`, in their order.

    Args:
        stream: Messages of all these topics, about in the order of time.
        reference: The topic that sets the pace.
        others: The topics whose nearest message is wanted.
        tolerance: Farther off than this a message does not count [ns].
    """
    waiting: deque[Message] = deque()
    held: dict[str, deque[Message]] = {name: deque() for name in others}

    def done(first: Message) -> tuple[Message, dict[str, Message | None]]:
        return first, {name: _nearest(messages, first.time, tolerance) for name, messages in held.items()}

    def forget(before: int) -> None:  # of what lies before that time only the last may still be the nearest
        for messages in held.values():
            while len(messages) > 1 and messages[1].time <= before:
                messages.popleft()

    newest = 0
    for message in stream:
        newest = max(newest, message.time)
        if message.topic == reference:
            waiting.append(message)
        elif message.topic in held:
            held[message.topic].append(message)
        while waiting:
            time = waiting[0].time
            complete = all(messages and messages[-1].time >= time for messages in held.values())
            if not complete and newest < time + PATIENCE:
                break
            yield done(waiting.popleft())
            forget(time)
        forget(newest - PATIENCE)
    while waiting:
        yield done(waiting.popleft())
