import math

import numpy as np
import pytest
import yaml
from PIL import Image

from drnav_jax.worlds import (
    check_trip,
    load_barn,
    load_floor_plan,
    load_map_server,
    load_moving_ai,
    load_occupancy,
    load_scenario,
    shortest_path,
    signed_distance,
    with_scenario,
)

HEADER = {
    "image": "map.png",
    "resolution": 0.5,
    "origin": [1.0, -2.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write_map(folder, pixels=((0, 205, 254), (255, 89, 90)), image_mode="L", **header):
    Image.fromarray(np.array(pixels, np.uint8), image_mode).save(folder / "map.png")
    return write_header(folder, **header)


def write_header(folder, **header):
    path = folder / "map.yaml"
    keys = {k: v for k, v in {**HEADER, **header}.items() if v is not ...}
    path.write_text(yaml.safe_dump(keys))
    return path


# Pixels 0 205 254 / 255 89 90 have p = 1 .196 .004 / 0 .651 .647; rows come out bottom first.
@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ({}, [[0, 100, -1], [100, -1, 0]]),
        ({"free_thresh": 0.25}, [[0, 100, -1], [100, 0, 0]]),
        ({"negate": 1}, [[100, -1, -1], [0, 100, 100]]),
        ({"negate": True, "mode": "trinary"}, [[100, -1, -1], [0, 100, 100]]),
        ({"mode": "scale"}, [[0, 100, 99], [100, 0, 0]]),
        ({"mode": "raw"}, [[-1, 89, 90], [0, -1, -1]]),
    ],
)
def test_modes(tmp_path, header, expected):
    values, origin, resolution = load_occupancy(write_map(tmp_path, **header))
    assert values.tolist() == expected and values.dtype == np.int8
    assert (origin, resolution) == ((1.0, -2.0), 0.5)


def test_thresholds_are_inclusive(tmp_path):
    path = write_map(tmp_path, [[204, 51]], free_thresh=0.2, occupied_thresh=0.8)
    assert load_occupancy(path)[0].tolist() == [[0, 100]]


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_what_is_not_opaque_is_unknown(tmp_path, mode):
    path = write_map(tmp_path, [[[254, 255], [254, 254], [0, 0]]], "LA", mode=mode)
    assert load_occupancy(path)[0].tolist() == [[0, -1, -1]]
    path = write_map(tmp_path, [[[254, 254, 254, 255], [9, 9, 9, 128]]], "RGBA", mode=mode)
    assert load_occupancy(path)[0].tolist() == [[0, -1]]


def test_raw_ignores_alpha(tmp_path):
    path = write_map(tmp_path, [[[100, 255], [7, 0]]], "LA", mode="raw")
    assert load_occupancy(path)[0].tolist() == [[100, 7]]


def test_unknown_is_solid_and_the_border_is_closed(tmp_path):
    scene = load_map_server(write_map(tmp_path))
    assert scene.occupied.shape == (4, 5) and scene.occupied[[0, -1]].all()
    assert scene.occupied[1:3, 1:4].tolist() == [[False, True, True], [True, True, False]]
    assert scene.origin == (0.5, -2.5) and not scene.outside_is_free and scene.name == "map"
    # The free pixel in the lower left corner keeps its place in the world.
    corner, above = signed_distance(scene.world, np.array([[1.25, -1.75], [1.25, -1.25]]))
    assert corner == pytest.approx(0.25) and above < 0


def test_a_closed_map_gets_no_ring(tmp_path):
    pixels = np.zeros((4, 5))
    pixels[1:3, 1:4] = 254
    scene = load_map_server(write_map(tmp_path, pixels))
    assert scene.occupied.shape == (4, 5) and scene.origin == (1.0, -2.0)


@pytest.mark.parametrize(("mode", "free"), [("raw", [True, True, False]), ("scale", [False] * 3)])
def test_the_middle_of_raw_and_scale_can_be_driven(tmp_path, mode, free):
    scene = load_map_server(write_map(tmp_path, [[0, 64, 65, 255]], mode=mode))
    assert (~scene.occupied[1, 1:4]).tolist() == free


def test_numbers_as_yaml_reads_them(tmp_path):
    path = write_map(tmp_path)
    path.write_text(path.read_text().replace("0.5", "5e-1", 1))  # text in YAML 1.1
    assert load_occupancy(path)[2] == 0.5


def test_image_path_is_relative_to_the_yaml(tmp_path, monkeypatch):
    (tmp_path / "maps" / "images").mkdir(parents=True)
    path = write_map(tmp_path / "maps", image="images/a.pgm")
    (tmp_path / "maps" / "map.png").unlink()
    (tmp_path / "maps" / "images" / "a.pgm").write_bytes(b"P5\n# by hand\n2 1\n255\n\xfe\x00")
    monkeypatch.chdir(tmp_path)
    assert load_occupancy("maps/map.yaml")[0].tolist() == [[0, 100]]
    assert path.is_file()


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"image": "none.png"}, r"none\.png: there is no such image"),
        ({"image": 5}, "image must be a file name, got 5"),
        ({"image": "map.yaml"}, "cannot be read as an image"),
        ({"image": "."}, "there is no such image"),
        ({"occupied_thresh": ...}, "lacks occupied_thresh"),
        ({"free_thresh": None, "origin": ...}, "lacks origin, free_thresh"),
        ({"resolution": math.nan}, "resolution must be finite, got nan"),
        ({"resolution": 0}, "resolution must be > 0"),
        ({"resolution": "fine"}, "resolution must be a number, got 'fine'"),
        ({"resolution": [0.1]}, "resolution must be a number"),
        ({"resolution": True}, "resolution must be a number"),
        ({"origin": [0, 0]}, r"origin must be \[x, y, yaw\]"),
        ({"origin": 0}, r"origin must be \[x, y, yaw\], got 0"),
        ({"origin": [0, 0, 0.1]}, "yaw is 0.1 rad; turned maps are not read"),
        ({"origin": [0, math.inf, 0]}, "origin must be finite"),
        ({"free_thresh": 0.7}, "free_thresh < occupied_thresh"),
        ({"occupied_thresh": 1.5}, "free_thresh < occupied_thresh <= 1, got 0.196 and 1.5"),
        ({"negate": "maybe"}, "negate must be 0 or 1, got 'maybe'"),
        ({"mode": "binary"}, "mode must be trinary, scale or raw, got 'binary'"),
        ({"mode": ["raw"]}, "mode must be trinary, scale or raw"),
    ],
)
def test_bad_headers_are_named(tmp_path, header, message):
    path = write_map(tmp_path, **header)
    with pytest.raises(ValueError, match=message) as caught:
        load_map_server(path)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected keys and values"),
        ("- 1\n- 2\n", "expected keys and values"),
        ("image: [", "not valid YAML"),
        ("image: !!python/object:os.system x", "not valid YAML"),
        ("a: &a [*a, *a]\n\0", "not valid YAML"),
        (b"\xff\xfe\x00\x80", "not a text file"),
        (None, "there is no such file"),
    ],
)
def test_files_that_are_no_header(tmp_path, text, message):
    path = tmp_path / "map.yaml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message) as caught:
        load_map_server(path)
    assert str(path) in str(caught.value)


def test_a_folder_is_no_file(tmp_path):
    for load in (load_map_server, load_barn, load_scenario):
        with pytest.raises(ValueError, match="cannot be read"):
            load(tmp_path)


def test_images_that_are_broken(tmp_path):
    path = write_map(tmp_path)
    good = (tmp_path / "map.png").read_bytes()
    for bad in (b"", good[:40], good[:20] + b"\xff" * 30, b"P5\n9999999 9999999\n255\n", b"P5\n2 x\n"):
        (tmp_path / "map.png").write_bytes(bad)
        with pytest.raises(ValueError, match=r"map\.png: cannot be read as an image"):
            load_map_server(path)


def test_a_map_without_free_cells(tmp_path):
    with pytest.raises(ValueError, match="no cell of the map is free; check negate"):
        load_map_server(write_map(tmp_path, [[0, 0]]))


def write_png16(path, rgb):
    """A 16-bit RGB PNG, which Pillow does not write."""
    import struct
    import zlib

    height, width, _ = rgb.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in rgb)

    def chunk(kind, data):
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


@pytest.mark.parametrize("kind", ["L", "1", "P", "RGB", "RGBA", "LA", "I;16", "RGB;16", "transparent P"])
def test_floor_plans_of_every_kind(tmp_path, kind):
    path = tmp_path / "plan.png"
    grey = np.array([[0, 100, 200, 255]], np.uint8)
    opaque = [False, False, True, True]
    if kind == "I;16":
        Image.fromarray(grey.astype(np.uint16) * 257).save(path)
    elif kind == "RGB;16":
        write_png16(path, np.repeat(grey[..., None].astype(np.uint16) * 257, 3, axis=2))
    elif kind in ("LA", "RGBA"):
        image = Image.fromarray(grey).convert(kind)
        image.putalpha(Image.fromarray(np.array([[255, 255, 0, 255]], np.uint8)))
        image.save(path)
        opaque = [False, False, False, True]
    elif kind == "transparent P":
        Image.fromarray(grey).convert("P").save(path, transparency=200)
        opaque = [False, False, False, True]
    else:
        Image.fromarray(grey).convert(kind, dither=Image.Dither.NONE).save(path)
    scene = load_floor_plan(path, 0.2)
    assert (~scene.occupied[1, 1:-1]).tolist() == opaque
    assert scene.origin == (-0.2, -0.2) and scene.resolution == 0.2


def test_luminance_decides(tmp_path):
    green, blue = [0, 255, 0], [0, 0, 255]
    Image.fromarray(np.array([[green, blue]], np.uint8)).save(tmp_path / "plan.png")
    assert (~load_floor_plan(tmp_path / "plan.png", 0.1).occupied[1, 1:-1]).tolist() == [True, False]


def test_the_outside_of_a_plan_can_be_filled(tmp_path):
    pixels = np.full((60, 80), 255, np.uint8)
    pixels[20:40, 20:60] = 0
    pixels[22:38, 22:58] = 255
    pixels[38:40, 30:35] = 255  # a door, 0.5 m
    Image.fromarray(pixels).save(tmp_path / "plan.png")
    free = ~load_floor_plan(tmp_path / "plan.png", 0.1, outside_gap=0.6).occupied
    rows, cols = np.nonzero(free)
    assert 20 <= rows.min() <= 22  # a part of the door stays
    assert (rows.max(), cols.min(), cols.max()) == (37, 22, 57)
    assert (~load_floor_plan(tmp_path / "plan.png", 0.1).occupied).sum() > 4000
    with pytest.raises(ValueError, match="gaps wider than 0.4 m let the outside in"):
        load_floor_plan(tmp_path / "plan.png", 0.1, outside_gap=0.4)
    with pytest.raises(ValueError, match="outside_gap must be > 0"):
        load_floor_plan(tmp_path / "plan.png", 0.1, outside_gap=0.0)


@pytest.mark.parametrize("resolution", [0.0, -1.0, math.nan, math.inf])
def test_a_resolution_must_be_positive(tmp_path, resolution):
    Image.new("L", (3, 3), 255).save(tmp_path / "plan.png")
    (tmp_path / "a.map").write_text("type octile\nheight 1\nwidth 1\nmap\n.\n")
    with pytest.raises(ValueError, match=r"plan\.png: resolution must be"):
        load_floor_plan(tmp_path / "plan.png", resolution)
    with pytest.raises(ValueError, match=r"a\.map: resolution must be"):
        load_moving_ai(tmp_path / "a.map", resolution)


MOVING_AI = "type octile\nheight 3\nwidth 4\nmap\n.GS@\nOTW.\n@@@@\n"


def test_moving_ai_map_and_scenario(tmp_path):
    (tmp_path / "a.map").write_text(MOVING_AI)
    (tmp_path / "a.map.scen").write_text("version 1\n0\ta.map\t4\t3\t0\t0\t2\t0\t2.0\n\n")
    scene = load_moving_ai(tmp_path / "a.map", 0.5)
    expected = [[0, 0, 0, 0], [0, 0, 0, 1], [1, 1, 1, 0]]
    np.testing.assert_array_equal(~scene.occupied[1:-1, 1:-1], np.array(expected, bool))
    (trip,) = load_scenario(tmp_path / "a.map.scen")
    assert (trip.start, trip.goal, trip.optimal_length) == ((0, 0), (2, 0), 2.0)
    scene = with_scenario(scene, trip)
    assert scene.start == (0.25, 1.25, 0.0) and scene.goal == (1.25, 1.25)
    assert scene.reference_length == 1.0
    assert check_trip(scene, 0.2)[0] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="load the scenario that belongs"):
        with_scenario(scene, trip._replace(size=(5, 3)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("octile", "hex"), "must begin with the lines"),
        (("height 3", "height x"), "must begin with the lines"),
        (("height 3\nwidth 4\n", ""), "must begin with the lines"),
        (("height 3", "height 4"), "says 4 rows"),
        (("height 3", "height 2"), "says 2 rows"),
        (("height 3", "height -1"), "says -1 rows"),
        (("OTW.", "OTW"), "line 6 has 3 cells, the width is 4"),
        (("OTW.", "OT?."), r"line 6 holds \['\?'\]"),
        ((".GS@\nOTW.", "@@@@\n@@@@"), "no cell of the map is free"),
        ((MOVING_AI, ""), "must begin with the lines"),
    ],
)
def test_bad_moving_ai_maps_are_named(tmp_path, change, message):
    (tmp_path / "bad.map").write_text(MOVING_AI.replace(*change))
    with pytest.raises(ValueError, match=rf"bad\.map: .*{message}"):
        load_moving_ai(tmp_path / "bad.map", 0.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "version 1"),
        ("0\ta\t4\t3\t0\t0\t2\t0\t2.0\n", "version 1"),
        ("version 1\n0\ta\t4\t3\t0\t0\t2\t0\n", "line 2 must be"),
        ("version 1\n0\ta\t4\t3\t0\tx\t2\t0\t1\n", "line 2 must be"),
        ("version 1\n0\ta\t4\t3\t0\t0\t2\t0\tnan\n", "line 2 has the length nan"),
        ("version 1\n\n0\ta\t4\t3\t0\t3\t2\t0\t1\n", r"line 3: cell \(0, 3\) is outside"),
    ],
)
def test_bad_scenarios_are_named(tmp_path, text, message):
    (tmp_path / "bad.scen").write_text(text)
    with pytest.raises(ValueError, match=rf"bad\.scen: .*{message}"):
        load_scenario(tmp_path / "bad.scen")


def model(name, shape, pose="0 0 0 0 0 0", link="", collision=""):
    return (
        f"<model name='{name}'><pose frame=''>{pose}</pose><link name='link'>{link}"
        f"<collision name='c'>{collision}<geometry>{shape}</geometry></collision></link></model>"
    )


BOX = "<box><size>2 1 0.5</size></box>"
CYLINDER = "<cylinder><radius>0.3</radius><length>1</length></cylinder>"
PLANE = model("ground", "<plane><normal>0 0 1</normal><size>9 9</size></plane>")


def write_barn(folder, *parts):
    path = folder / "world_7.world"
    path.write_text(f"<sdf version='1.6'><world name='default'>{''.join(parts)}</world></sdf>")
    return path


def test_barn_shapes_poses_and_trip(tmp_path):
    path = write_barn(
        tmp_path,
        PLANE,
        "<include><uri>model://sun</uri></include>",
        model("a", CYLINDER, "-2 6 0.5 0 0 0"),
        model("b", BOX, "1 2 0 0 0 1.5707963", link="<pose>1 0 0 0 0 0</pose>"),
        model("c", CYLINDER, "9 9 0 0 0 0"),
        "<state><model name='c'><pose>-3 7 0 0 0 0</pose></model></state>",
    )
    scene = load_barn(path)
    np.testing.assert_allclose(scene.world.cylinders, [[-2, 6, 0.3, 0, 1], [-3, 7, 0.3, -0.5, 0.5]])
    box = [[1, 3, np.pi / 2, 1, 0.5, -0.25, 0.25]]
    np.testing.assert_allclose(scene.world.boxes, box, atol=1e-6)
    assert scene.start == (-2.0, 3.0, 1.57) and scene.goal == (-2.0, 13.0)
    assert (scene.goal_tolerance, scene.time_limit, scene.reference_length) == (1.0, 100.0, None)
    assert scene.outside_is_free and scene.name == "world_7"
    np.save(tmp_path / "path_7.npy", np.array([[17, 0], [17, 20]]))
    expected = math.hypot(0.025, 2.075) + 3.0 + math.hypot(0.025, 4.925)
    assert load_barn(path).reference_length == pytest.approx(expected)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("", "no box and no cylinder"),
        (PLANE, "no box and no cylinder"),
        ("<model", "not valid XML"),
        (model("m", "<mesh><uri>x.dae</uri></mesh>"), "model m has mesh; only boxes"),
        (model("m", ""), "model m has no shape"),
        (model("m", BOX, "0 0 0 0.5 0 0"), "tilted"),
        (model("m", BOX, "0 0 0"), "a pose must be 6 finite numbers"),
        (model("m", BOX, "0 0 nan 0 0 0"), "a pose must be 6 finite numbers"),
        (model("m", "<box/>"), "the size of m must be 3 finite numbers"),
        (model("m", BOX.replace("2", "-2")), "model m has a size that is not > 0"),
        (model("m", CYLINDER.replace("0.3", "x")), "the radius of m must be 1 finite"),
        (model("m", BOX, "5000 0 0 0 0 0"), "the limit is 1000 m"),
        ("<include><uri>model://table</uri></include>", "includes 'model://table'"),
    ],
)
def test_bad_barn_worlds_are_named(tmp_path, part, message):
    with pytest.raises(ValueError, match=rf"world_7\.world: .*{message}"):
        load_barn(write_barn(tmp_path, part))


def test_other_xml_is_no_world(tmp_path):
    (tmp_path / "a.world").write_text("<robot/>")
    with pytest.raises(ValueError, match=r"a\.world: no <sdf><world> in it"):
        load_barn(tmp_path / "a.world")


@pytest.mark.parametrize("content", [b"", b"nonsense", "shape", "type"])
def test_bad_reference_paths_are_named(tmp_path, content):
    path = write_barn(tmp_path, model("a", CYLINDER))
    if isinstance(content, bytes):
        (tmp_path / "path_7.npy").write_bytes(content)
    else:
        bad = {"shape": np.zeros(4), "type": np.array([["a", "b"]])}[content]
        np.save(tmp_path / "path_7.npy", bad)
    with pytest.raises(ValueError, match=r"path_7\.npy: not a reference path"):
        load_barn(path)


# Free area [m^2] as it stands in the files.
@pytest.mark.parametrize(
    ("file", "area"),
    [
        ("willow/willow-2010-02-18-0.10.yaml", 1092),
        ("nav2/depot.yaml", 449),
        ("nav2/warehouse.yaml", 1280),
        ("aws_warehouse/map.yaml", 234),
    ],
)
def test_real_maps(shared_data, file, area):
    scene = load_map_server(shared_data / "maps" / file)
    assert (~scene.occupied).sum() * scene.resolution**2 == pytest.approx(area, abs=1)


def test_real_floor_plans(shared_data):
    folder = shared_data / "maps" / "bench_mr"
    free = ~load_floor_plan(folder / "freiburg.png", 0.05, outside_gap=0.8).occupied
    assert 300 < free.sum() * 0.05**2 < 450  # the building without its surroundings
    assert load_floor_plan(folder / "intel-lab.png", 0.05).occupied.shape == (583, 581)


def test_real_barn_worlds(shared_data):
    for file in sorted((shared_data / "barn").glob("*.world"))[:5]:
        scene = load_barn(file)
        assert len(scene.world.cylinders) > 150 and len(scene.world.boxes) == 0
        length, _ = shortest_path(scene, scene.start, scene.goal, 0.25)
        assert 10.0 <= length <= scene.reference_length


def test_real_moving_ai_maps(shared_data):
    for file in sorted((shared_data / "movingai").glob("*.map"))[:2]:
        scene = load_moving_ai(file, 1.0)
        trips = load_scenario(f"{file}.scen")
        for trip in trips[:: len(trips) // 4]:
            scene = with_scenario(scene, trip)
            found = shortest_path(scene, scene.start, scene.goal, 0.4)
            # Any angle is shorter than 8 directions, keeping off the walls longer.
            assert 0.9 * scene.reference_length <= found[0] <= 1.1 * scene.reference_length + 1
