"""Time matching against comparing all with all."""

from hypothesis import given
from hypothesis import strategies as st

from drnav_jax.bags import sync
from drnav_jax.bags.reader import Message

TIMES = st.lists(st.integers(0, 400), max_size=12, unique=True).map(sorted)
MS = 10_000_000  # [ns] one step of the times above: the whole takes 4 s


def stream(lags, **topics):
    """Messages in the order of recording: each topic lags by so much."""
    all_ = [(t + lags.get(name, 0), Message(name, t * MS, k)) for name, ts in topics.items() for k, t in enumerate(ts)]
    return [m for _, m in sorted(all_, key=lambda pair: pair[0])]


@given(TIMES, TIMES, TIMES, st.integers(0, 60), st.integers(0, 20), st.integers(0, 20))
def test_the_nearest_of_all(reference, left, right, tolerance, lag_left, lag_right):
    messages = stream({"left": lag_left, "right": lag_right}, reference=reference, left=left, right=right)
    found = list(sync.matched(messages, "reference", ["left", "right"], tolerance * MS))
    assert [m.time for m, _ in found] == [t * MS for t in reference]
    for message, partners in found:
        for name, times in (("left", left), ("right", right)):
            off = min((abs(t * MS - message.time) for t in times), default=None)
            if off is None or off > tolerance * MS:
                assert partners[name] is None
            else:
                assert abs(partners[name].time - message.time) == off


def test_a_topic_that_ends_holds_nothing_up():
    seen = []

    def watched():
        for k in range(1000):
            seen.append(k)
            yield Message("a", k * 100 * 1_000_000, k)
            if k == 0:
                yield Message("b", 0, 0)

    found = sync.matched(watched(), "a", ["b"], 50_000_000)
    first, partners = next(found)
    assert partners["b"] is not None
    for _ in range(10):
        first, partners = next(found)
    assert partners["b"] is None and first.content == 10
    assert len(seen) <= 10 + 2 + sync.PATIENCE // 100_000_000  # not the whole bag


def test_no_more_is_held_than_patience_allows(monkeypatch):
    sizes = []
    nearest = sync._nearest
    monkeypatch.setattr(sync, "_nearest", lambda held, *a: sizes.append(len(held)) or nearest(held, *a))
    step = 10_000_000
    late = [*(Message("b", k * step, k) for k in range(5000)), Message("a", 4999 * step, 0)]
    ((_, partners),) = sync.matched(late, "a", ["b"], step)
    assert partners["b"].content == 4999 and sizes == [sync.PATIENCE // step + 1]


def test_without_others_all_pass():
    found = list(sync.matched([Message("a", k, k) for k in range(3)], "a", [], 0))
    assert [m.content for m, _ in found] == [0, 1, 2] and all(p == {} for _, p in found)
