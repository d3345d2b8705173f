"""The generated constants and the probe table."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from bake_core.shader_compiler import shader_text
from bake_core.shader_constants import bundle_constants, probe_texels, surface_bias
from tests.conformance import synthetic


def test_constants_are_the_same_text_every_time_and_read_back() -> None:
    volumes = synthetic.volumes()
    text = bundle_constants(volumes)
    assert text == bundle_constants(volumes)
    rows = re.findall(r"^    .*volume = ObVolume\((.*)\); // (.*)$", text, re.MULTILINE)
    assert [name for _, name in rows] == ["fine", "coarse", "flat"]
    for (row, _), volume in zip(rows, volumes, strict=True):
        numbers = [float(x) for x in re.findall(r"(?<![A-Za-z0-9])-?[0-9][0-9.e+-]*", row)]
        expected = [
            *volume.origin,
            *volume.spacing,
            *volume.counts,
            volume.atlases["irradiance"].columns,
            volume.atlases["irradiance"].rows,
            4,
            4 * ("walls" in volume.atlases),
        ]
        expected += [volume.spacing.min(), volume.distance_limit, *surface_bias(volume), 0.3, 0.05]
        np.testing.assert_array_equal(np.array(numbers, np.float32), np.array(expected, np.float32))


def test_every_field_of_the_struct_is_filled_in_its_order() -> None:
    struct = re.search(r"struct ObVolume \{(.*?)\};", shader_text("grid.glsl"), re.DOTALL)
    assert struct
    types = re.findall(r"^\s*(\w+) \w+;", struct[1], re.MULTILINE)
    assert types == ["vec3", "vec3", "ivec3", "ivec2", "int", "int", *["float"] * 6]


def test_a_frame_far_from_zero_keeps_its_millimetres() -> None:
    volume = replace(synthetic.volume("far", (0, 0, 0), (1, 1, 1), (2, 2, 2)), origin=np.array([1e6 + 0.001, 0, 0]))
    assert "vec3(0.001, 0.0, 0.0)" in bundle_constants((volume,), (1e6, 0, 0))


def test_bias_is_relative_to_the_smallest_spacing_that_matters() -> None:
    assert surface_bias(synthetic.volume("v", (0, 0, 0), (3, 2, 1), (4, 4, 4))) == pytest.approx((0.045, 0.18))
    assert surface_bias(synthetic.volume("v", (0, 0, 0), (3, 2, 1), (4, 4, 1))) == pytest.approx((0.09, 0.36))
    assert surface_bias(synthetic.volume("v", (0, 0, 0), (3, 2, 1), (1, 1, 1))) == pytest.approx((0.045, 0.18))


def test_probe_table_holds_all_probes_and_numbers_the_tiles() -> None:
    volume = synthetic.volume("v", (0, 0, 0), (1, 1, 1), (4, 3, 2), inactive=(0, 23), moved=True)
    texels = probe_texels(volume).reshape(-1, 4)[:24].reshape(2, 3, 4, 4)
    assert texels.dtype == np.float32
    np.testing.assert_array_equal(texels[1, 2, 1, :3], volume.offsets[1 + 4 * (2 + 3 * 1)])
    np.testing.assert_array_equal(texels[..., 3].ravel(), [0, *range(1, 23), 0])


def test_probe_table_fills_up_a_packed_layout_with_dead_probes() -> None:
    """Seven probes in layers of 2 x 2 tiles: one place is left over."""
    volume = synthetic.volume("v", (0, 0, 0), (1, 1, 1), (7, 1, 1))
    packed = {k: replace(a, columns=2, rows=2, layers=2) for k, a in volume.atlases.items()}
    np.testing.assert_array_equal(probe_texels(replace(volume, atlases=packed))[..., 3].ravel(), [*range(1, 8), 0])


def test_atlases_of_two_layouts_are_refused() -> None:
    volume = synthetic.volume("v", (0, 0, 0), (1, 1, 1), (4, 1, 1))
    mixed = {**volume.atlases, "walls": replace(volume.atlases["walls"], columns=2, rows=2)}
    with pytest.raises(ValueError, match="one tile layout"):
        bundle_constants((replace(volume, atlases=mixed),))
