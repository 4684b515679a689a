import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drnav_jax import sources
from drnav_jax.sources import Source

RADIUS, CLEARANCE = 0.25, 0.4


def load(**flags):
    return sources.load(Source(**flags), RADIUS, CLEARANCE)


def plan(folder: Path, outside: int = 255) -> Path:
    """A closed hall of 20 x 12 m in a light or dark surrounding; 0.1 m a pixel."""
    pixels = np.full((160, 240), outside, np.uint8)
    pixels[20:140, 20:220] = 0
    pixels[22:138, 22:218] = 255
    pixels[40:120, 118:122] = 0
    file = folder / "hall.png"
    Image.fromarray(pixels).save(file)
    return file


def moving_ai(folder: Path, lengths=()) -> Path:
    file = folder / "field.map"
    file.write_text("type octile\nheight 40\nwidth 50\nmap\n" + "\n".join(["." * 50] * 40) + "\n")
    if lengths:
        lines = [f"0\tfield.map\t50\t40\t2\t5\t{2 + n}\t5\t{n}" for n in lengths]
        (folder / "field.map.scen").write_text("version 1\n" + "\n".join(lines) + "\n")
    return file


BARN = """<sdf version="1.6"><world name="w"><model name="post"><pose>0 6 0.5 0 0 0</pose><link name="l">
<collision name="c"><geometry><cylinder><radius>0.2</radius><length>1</length></cylinder></geometry></collision>
</link></model></world></sdf>"""


def test_a_family_takes_consecutive_seeds():
    scenes = load(world="u:3", episodes=3)
    assert [s.name for s in scenes] == ["u:3", "u:4", "u:5"]
    (moved,) = load(world="u:3", start="-20,3.5,1.57", goal="-30,1")
    assert (moved.start, moved.goal) == ((-20.0, 3.5, 1.57), (-30.0, 1.0))
    (other,) = load(world="u:3", split="train")
    assert other.goal != scenes[0].goal


def test_trips_on_a_map_are_sampled_by_seed(tmp_path):
    flags = {"map": plan(tmp_path), "resolution": 0.1}
    trips = load(**flags, episodes=4, seed=1)
    assert [t.name for t in trips] == [f"hall#{k}" for k in range(4)]
    again, other = load(**flags, episodes=4, seed=1), load(**flags, episodes=4, seed=2)
    assert [t.start for t in trips] == [t.start for t in again] != [t.start for t in other]
    same = load(**flags, episodes=2, start="4,4,0", goal="18,4")
    assert [(t.start, t.goal) for t in same] == [((4.0, 4.0, 0.0), (18.0, 4.0))] * 2


def test_the_light_outside_of_a_building_is_no_place_to_drive(tmp_path):
    trips = load(map=plan(tmp_path), resolution=0.1, episodes=8)
    for x, y in [t.start[:2] for t in trips] + [t.goal for t in trips]:
        assert 2.0 < x < 22.0 and 2.0 < y < 14.0
    dark = load(map=plan(tmp_path, outside=0), resolution=0.1)[0]
    assert np.count_nonzero(~dark.occupied) == np.count_nonzero(~trips[0].occupied)


def test_a_plan_without_outer_walls_is_taken_as_it_is(tmp_path):
    file = tmp_path / "yard.png"
    pixels = np.full((150, 150), 255, np.uint8)
    pixels[70:80, 70:80] = 0
    Image.fromarray(pixels).save(file)
    assert len(load(map=file, resolution=0.1)) == 1


def test_moving_ai_takes_the_trips_of_its_scenario_if_they_are_long_enough(tmp_path):
    sampled = load(movingai=moving_ai(tmp_path), episodes=2)
    assert all(t.reference_length is None for t in sampled)
    trips = load(movingai=moving_ai(tmp_path, (4, 9, 12)), episodes=2)
    assert sorted(t.goal[0] - t.start[0] for t in trips) == [9.0, 12.0]
    assert all(t.reference_length is None for t in trips)  # else it would be taken for BARN's
    more = load(movingai=moving_ai(tmp_path, (4, 9, 12)), episodes=3)  # only two are 8 m long
    assert len(more) == 3 and more[0].goal[1] != more[0].start[1]
    fine = load(movingai=moving_ai(tmp_path, (4, 9, 12)), resolution=2.0, episodes=3)
    assert sorted(t.goal[0] - t.start[0] for t in fine) == [8.0, 18.0, 24.0]


def test_a_folder_of_barn_worlds_in_the_order_of_their_numbers(tmp_path):
    for k in (10, 9, 100):
        (tmp_path / f"world_{k}.world").write_text(BARN)
    scenes = load(barn=tmp_path)
    assert [s.name for s in scenes] == ["world_9", "world_10", "world_100"]
    assert {(s.time_limit, s.goal_tolerance) for s in scenes} == {(100.0, 1.0)}
    assert [s.name for s in load(barn=tmp_path / "world_9.world", episodes=2)] == ["world_9"] * 2


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({}, "exactly one of .* got none"),
        ({"world": "u:0", "map": Path("a.yaml")}, "got --world and --map"),
        ({"world": "u"}, "FAMILY:SEED"),
        ({"world": "u:-1"}, "FAMILY:SEED"),
        ({"world": ":3"}, "FAMILY:SEED"),
        ({"world": "w:0"}, "unknown family"),
        ({"world": "u:0", "episodes": 0}, "episodes"),
        ({"world": "u:0", "seed": -1}, "seed"),
        ({"world": "u:0", "split": "exam"}, "split"),
        ({"world": "u:0", "resolution": 0.1}, "--resolution belongs to"),
        ({"world": "u:0", "start": "1,2"}, "--start must be X,Y,YAW"),
        ({"world": "u:0", "start": "1,2,up"}, "--start must be X,Y,YAW"),
        ({"world": "u:0", "goal": "1,inf"}, "--goal must be X,Y"),
        ({"map": Path("none.png")}, "add --resolution"),
        ({"map": Path("none.png"), "resolution": 0.1}, "no such image"),
        ({"map": Path("none.yaml")}, "no such file"),
        ({"map": Path("none.yaml"), "resolution": 0.1}, "its own resolution"),
        ({"map": Path("none.map"), "resolution": 0.1}, "--movingai"),
        ({"barn": Path("none.world")}, "no such file"),
        ({"movingai": Path("none.map")}, "no such file"),
    ],
)
def test_mistakes_are_named(flags, message):
    with pytest.raises(ValueError, match=message):
        load(**flags)


def test_mistakes_with_files_are_named(tmp_path):
    with pytest.raises(ValueError, match="no .world file"):
        load(barn=tmp_path)
    with pytest.raises(ValueError, match="both --start and --goal"):
        load(map=plan(tmp_path), resolution=0.1, start="4,4,0")
    with pytest.raises(ValueError, match="resolution"):
        load(map=plan(tmp_path), resolution=-1.0)
    with pytest.raises(ValueError, match="hall"):  # 2 x 1.2 m
        load(map=plan(tmp_path), resolution=0.01)


def test_flags_of_the_command_line_are_those_of_a_source():
    from drnav_jax import cli

    assert {f.name for f in dataclasses.fields(Source)} < {f.name for f in dataclasses.fields(cli.Trial)}
