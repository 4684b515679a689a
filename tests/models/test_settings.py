"""Specs and Params as mappings: what a YAML file says, and what it must not say."""

import dataclasses
import json

import pytest
from small_network import SPEC

from drnav_jax.models import settings
from drnav_jax.models.efficientnet import EncoderSpec, b0
from drnav_jax.models.losses import LossParams
from drnav_jax.models.network import NetworkSpec
from drnav_jax.train import TrainSpec


@pytest.mark.parametrize(
    "value",
    [
        SPEC, NetworkSpec(), b0(0.5, resolution=(64, 80), num_classes=7), LossParams(gamma=2.0), TrainSpec(),
        TrainSpec(network=SPEC, loss=LossParams(path=0.0), steps=7),
    ],
    ids=lambda v: type(v).__name__,
)  # fmt: skip
def test_there_and_back_through_json(value):
    text = json.dumps(settings.plain(value))
    again = settings.built(type(value), json.loads(text))
    assert again == value and type(again) is type(value)
    if dataclasses.is_dataclass(value):
        assert hash(again) == hash(value)  # lists have become tuples, all the way down


def test_what_is_not_named_keeps_its_default():
    got = settings.built(TrainSpec, {"network": {"encoder": {"width": 0.5}}, "loss": {"gamma": 2}})
    assert got == TrainSpec(network=NetworkSpec(encoder=EncoderSpec(width=0.5)), loss=LossParams(gamma=2))
    assert settings.built(TrainSpec, {}) == TrainSpec()


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"step": 5}, r"no step: choose from .*steps"),
        ({"network": {"encoder": {"wide": 1}}}, r"no network\.encoder\.wide: choose from .*width"),
        ({"loss": {"focal": 1}}, r"no loss\.focal: choose from .*gamma"),
        ({"network": {"features": 0}}, "features must be >= 1"),
        ({"steps": 0}, "steps must be >= 1"),
        ({"network": 3}, "network must be a mapping"),
        ({"loss": [1, 2]}, "loss must be a mapping"),
        ({"network": {"bev": None}}, r"network\.bev must be a mapping"),
        ({"learning_rate": "1e-3"}, "learning_rate must be a number, got '1e-3'"),  # what YAML makes of 1e-3
        ({"loss": {"gamma": "2"}}, r"loss\.gamma must be a number"),
        ({"steps": 10.5}, "steps must be a whole number"),
        ({"steps": True}, "steps must be a whole number"),
        ({"network": {"rule": "no"}}, r"network\.rule must be true or false"),
        ({"network": {"head": 1}}, r"network\.head must be text"),
        ({"network": {"point_widths": 8}}, r"network\.point_widths must be a list"),
        ({"network": {"encoder": {"stages": 3}}}, r"network\.encoder\.stages must be a list"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_by_its_name(values, says):
    with pytest.raises(ValueError, match=says):
        settings.built(TrainSpec, values)


def test_whole_numbers_are_numbers():
    assert settings.built(TrainSpec, {"learning_rate": 1}).learning_rate == 1
    assert settings.built(NetworkSpec, {"encoder": {"resolution": None}}).encoder.resolution is None
    assert settings.built(NetworkSpec, {"encoder": {"resolution": [32, 40]}}).encoder.resolution == (32, 40)
