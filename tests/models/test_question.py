"""What a model is asked, and how its answer is read: whatever it says, it is read or refused, never a crash."""

import base64
import io
import json

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from PIL import Image

from drnav_jax.models import question
from drnav_jax.models.views import WAYS

GOOD = {"front": "open", "left": "blocked", "right": "open", "dead_end": False}
PLAIN = json.dumps(GOOD)


def pixels(url):
    assert url.startswith("data:image/png;base64,")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1], validate=True))))


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        f"```json\n{json.dumps(GOOD, indent=2)}\n```",
        f"Here is what I see: {PLAIN} I hope this helps {{really}}.",
        f"<think>If {{x}} then {{\"front\": \"blocked\"}}? No.</think>\n\n{PLAIN}",
        PLAIN.replace("open", " OPEN ").replace("blocked", "Blocked"),
        json.dumps({**GOOD, "reason": {"front": "blocked"}, "confidence": None}),
        "{" * 3000 + PLAIN,
        "x" * 50_000 + PLAIN,
    ],
)
def test_what_stands_around_the_object_does_not_matter(text):
    assert question.read(text, WAYS) == ({"front": 1.0, "left": 0.0, "right": 1.0}, 0.0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no JSON object"),
        ("front is open, left is blocked", "no JSON object"),
        (PLAIN[:-1], "no JSON object"),
        (PLAIN + "x" * 20_000, "no JSON object"),  # only an answer's end is read
        ("[" + '"open", ' * 3 + "false]", "no JSON object"),
        ('{"a":' * 5000, "no JSON object"),
        (json.dumps({**GOOD, "left": "closed"}), '"left" must be'),
        (json.dumps({**GOOD, "left": True}), '"left" must be'),
        (json.dumps({**GOOD, "left": ["open"]}), '"left" must be'),
        (json.dumps({k: v for k, v in GOOD.items() if k != "right"}), '"right" must be'),
        (json.dumps({**GOOD, "dead_end": "false"}), '"dead_end" must be'),
        (json.dumps({**GOOD, "dead_end": None}), '"dead_end" must be'),
        (json.dumps({**GOOD, "confidence": 95}), '"confidence" must'),
        (json.dumps({**GOOD, "confidence": "high"}), '"confidence" must'),
        (json.dumps({**GOOD, "confidence": True}), '"confidence" must'),
        (json.dumps({**GOOD, "confidence": float("nan")}), '"confidence" must'),
        (json.dumps({**GOOD, "confidence": {"dead_end": -0.1}}), '"confidence" must'),
    ],
)
def test_what_the_prompt_does_not_allow_is_refused(text, match):
    with pytest.raises(ValueError, match=match):
        question.read(text, WAYS)


def test_confidence_tempers_a_word_but_never_turns_it():
    sure = {"front": 0.9, "left": 0.8, "dead_end": 0.3}
    path, dead_end = question.read(json.dumps({**GOOD, "confidence": sure}), WAYS)
    assert path == pytest.approx({"front": 0.9, "left": 0.2, "right": 1.0})
    assert dead_end == pytest.approx(0.49)
    path, dead_end = question.read(json.dumps({**GOOD, "confidence": 0.75}), WAYS)
    assert path == {"front": 0.75, "left": 0.25, "right": 0.75} and dead_end == 0.25


def test_only_the_ways_asked_about_are_read():
    text = json.dumps({"front": "blocked", "right": "no idea", "dead_end": True})
    assert question.read(text, ["front"]) == ({"front": 0.0}, 1.0)
    assert question.read(text, []) == ({}, 1.0)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.sampled_from(["open", "blocked"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*WAYS, "dead_end", "confidence"]), inner),
)


@hypothesis.given(st.one_of(st.text(), JSON.map(json.dumps), JSON.map(lambda v: json.dumps({**GOOD, "confidence": v}))))
def test_any_text_is_read_or_refused(text):
    try:
        path, dead_end = question.read(text, WAYS)
    except ValueError:
        return
    assert set(path) == set(WAYS) and all(0 <= p <= 1 for p in (*path.values(), dead_end))


def test_pictures_are_the_images_and_large_ones_shrink():
    image = np.random.default_rng(0).integers(0, 256, (6, 10, 3), dtype=np.uint8)
    np.testing.assert_array_equal(pixels(question.picture(image, 10)), image)
    np.testing.assert_array_equal(pixels(question.picture(image, 512)), image, err_msg="small ones stay as they are")
    smooth = np.broadcast_to(np.linspace(0, 250, 200)[None, :, None], (40, 200, 3)).astype(np.uint8)
    small = pixels(question.picture(smooth, 50))
    assert small.shape == (10, 50, 3)
    np.testing.assert_allclose(small[:, 1:-1], smooth[2::4, 6:-2:4], atol=3)  # a ramp: but for the ends its own mean
    assert pixels(question.picture(np.zeros((1, 100, 3), np.uint8), 10)).shape == (1, 10, 3)


def test_the_message_names_each_way_before_its_picture():
    images = {way: np.full((2, 3, 3), k, np.uint8) for k, way in enumerate(("front", "right"))}
    prompt, *rest = question.content(images, 64)
    assert prompt == {"type": "text", "text": question.PROMPT}
    assert [p["type"] for p in rest] == ["text", "image_url"] * 2
    assert [p["text"] for p in rest[::2]] == ["front:", "right:"]
    for part, image in zip(rest[1::2], images.values(), strict=True):
        np.testing.assert_array_equal(pixels(part["image_url"]["url"]), image)
