"""Maps of other tools, read as map_server and Nav2 read them."""

import re
import warnings

import numpy as np
import pytest
from PIL import Image

from mpfa_envs import World, load_world
from tests.envs.map_files import write_map


@pytest.mark.parametrize("kind", ["RGBA", "LA", "P"])
@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_transparent_white_is_unknown(mode, kind, tmp_path):
    pixels = np.full((3, 4, 4), 255, dtype=np.uint8)
    pixels[1, 1, 3] = 0
    image = Image.fromarray(pixels).convert(kind)
    transparent = {"transparency": 1} if kind == "P" else {}
    if kind == "P":
        image = Image.fromarray(np.where(pixels[..., 3], 0, 1).astype(np.uint8), "L").convert("P")
        image.putpalette([255] * 6)
    image.save(tmp_path / "map.png", **transparent)
    path = write_map(tmp_path, None, image="map.png", mode=mode)
    assert np.argwhere(load_world(path).occupancy.occupied).tolist() == [[1, 1]]
    assert not World.from_map(path, unknown="free").occupancy.occupied.any()


def test_opacity_is_averaged_in_as_by_map_server_but_gray_of_map_saver_stays_unknown(tmp_path):
    pixels = np.full((3, 12, 4), 255, dtype=np.uint8)
    # (254 + 254 + 254 + 100) / 4 is 216, p of 0.15; with 0 it is 191, p of 0.25.
    pixels[1, 1:12:3] = [[0, 0, 0, 255], [254] * 3 + [0], [254] * 3 + [100], [205] * 3 + [255]]
    Image.fromarray(pixels).save(tmp_path / "map.png")
    path = write_map(tmp_path, None, image="map.png")
    with pytest.warns(UserWarning, match="1 cells of shade 205 free.* free_thresh: 0.147"):
        found = load_world(path).occupancy.occupied[1:12:3, 1]
    assert found.tolist() == [True, True, False, True]


@pytest.mark.parametrize("opacity", [1, 128, 254])
@pytest.mark.parametrize("shade", [0, 255])
def test_a_pixel_that_is_not_wholly_opaque_is_unknown_in_mode_scale(shade, opacity, tmp_path):
    pixels = np.full((3, 4, 4), 255, dtype=np.uint8)
    pixels[1, 1] = [shade] * 3 + [opacity]
    Image.fromarray(pixels).save(tmp_path / "map.png")
    path = write_map(tmp_path, None, image="map.png", mode="scale")
    assert np.argwhere(load_world(path).occupancy.occupied).tolist() == [[1, 1]]
    assert not World.from_map(path, unknown="free").occupancy.occupied.any()


TRUTH = np.zeros((4, 3), dtype=bool)


TRUTH[1, 0] = True


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("negate: 0", "negate: 0\ntype: indoor\n? [a]\n: map_type", None),
        ("negate: 0", "negate: no", None),
        ("resolution: ", "resolution:\t", None),
        ("0.0]", "-1e-9]", None),
        ("0.196", "0.65", "free_thresh = 0.65 should be below occupied = 0.65"),
        ("occupied_thresh: 0.65", "occupied_thresh: 0.1", "should be below occupied = 0.1"),
        ("negate: 0", "negate: 0\nrezolution: 3", "'rezolution' .* did you mean 'resolution'"),
        ("free_thresh: 0.196", "free_thresh: 0.196\n---\nimage: other", None),
    ],
)
def test_what_map_server_accepts_is_read(old, new, told, tmp_path):
    shades = np.where(TRUTH.T[::-1], 0, 254).astype(np.uint8)
    path = write_map(tmp_path, shades)
    assert old in path.read_text()
    path.write_bytes(path.read_text().replace(old, new).encode("latin-1"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        world = load_world(path)
    np.testing.assert_array_equal(world.occupancy.occupied, TRUTH)
    assert len(caught) == (told is not None)
    if told is not None:
        assert caught[0].filename == __file__
        assert re.search(told, str(caught[0].message))


@pytest.mark.parametrize(
    ("yaw", "occupied", "origin"),
    [
        # The lower left corner of the image is at (-1, 2); its cells are 0.05 m.
        ("1.5708", [2, 1], (-1.15, 2.0)),
        ("3.141592653589793", [2, 2], (-1.2, 1.85)),
        ("-1.5707963", [0, 2], (-1.0, 1.8)),
        ("-6.283185307", [1, 0], (-1.0, 2.0)),
    ],
)
def test_an_origin_turned_by_quarters_turns_the_cells_about_it(yaw, occupied, origin, tmp_path):
    shades = np.where(TRUTH.T[::-1], 0, 254).astype(np.uint8)
    world = load_world(write_map(tmp_path, shades, origin=f"[-1.0, 2.0, {yaw}]"))
    assert np.argwhere(world.occupancy.occupied).tolist() == [occupied]
    assert world.occupancy.origin == pytest.approx(origin)
