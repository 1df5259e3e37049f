"""Materials of obstacles: fluids that absorb, porous ones and impedances, in scenes, files and regions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.io.scene_file import scene_lines
from autdtorch.propagators.plan import region_of, with_rigid
from autdtorch.utils.digest import digest_of

AIR = at.Medium(1.2, 343.0)
ARRAY = at.TransducerArray.grid((2, 2), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
FOAM = {"density": 1.7 + 1.1j, "sound_speed": 239.0 - 80j}
ABSORBING = {"density": 1000.0, "sound_speed": 1500.0, "absorption": 40.0}


def box(**material):
    return at.Box((0.0, 0.0, 0.1), (0.05, 0.05, 0.01), **material)


def scene_of(*obstacles, medium=AIR, frequency=40e3):
    return at.Scene(ARRAY, medium, frequency, [[0.0, 0.0, 0.15]], obstacles)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ({}, "density: None; must have both density and sound_speed, or else rigid=True or an impedance"),
        ({"rigid": True, "absorption": 3.0}, "absorption: 3.0 dB/m; must be 0: a rigid body"),
        ({"impedance": 2.0, "absorption": 3.0}, "absorption: 3.0 dB/m; must be 0 beside an impedance"),
        (FOAM | {"absorption": 3.0}, "absorption: 3.0 dB/m; must be 0 beside an impedance or complex"),
        ({"rigid": True, "impedance": 2.0}, "impedance: 2.0; must have either an impedance, a material"),
        (FOAM | {"impedance": 2.0}, "impedance: 2.0; must have either an impedance, a material"),
        ({"impedance": -0.1 + 2j}, "impedance: .*; must have a real part >= 0: a negative one adds energy"),
        (
            {"impedance": 1.6e6},
            "impedance: 1600000.0; must have a size of 0.01 to 1e\\+06, as a ratio to density times sound",
        ),
        (FOAM | {"density": 1.7 - 1j}, "density: .* imaginary part >= 0.*take the conjugate"),
        (FOAM | {"sound_speed": 239 + 8j}, "sound_speed: .* imaginary part <= 0.*take the conjugate"),
        (FOAM | {"sound_speed": 239.0}, "sound_speed: 239.0; .* imaginary part <= 0; it is"),
        (FOAM | {"density": -1 + 1j}, "density: -1.0 kg/m"),
        (ABSORBING | {"absorption": -1.0}, "absorption: -1.0 dB/m; must be finite and >= 0"),
    ],
)
def test_impossible_materials_are_refused(material, message):
    with pytest.raises(ValueError, match=f"^Box.{message}"):
        box(**material)


def test_absorption_that_leaves_no_wave_is_refused_by_the_scene():
    with pytest.raises(ValueError, match=r"obstacles\[0\].absorption: 800.0 dB/m; must be at most 720 dB/m"):
        scene_of(box(**ABSORBING | {"absorption": 800.0}))


def test_complex_numbers_without_an_imaginary_part_are_real():
    assert box(density=np.complex128(1.2), sound_speed=300 - 0j) == box(density=1.2, sound_speed=300.0)
    assert isinstance(box(density=1.2 + 0j, sound_speed=300).density, float)


@given(st.floats(20, 20e6), st.floats(0.011, 0.99), st.floats(0.1, 1000))
def test_porous_materials_are_passive_obstacles(frequency, ratio, density):
    medium = at.Medium(density, 343.0)
    material = at.porous(frequency / ratio, frequency, medium)
    body = box(**material)  # which is refused unless it is passive
    inner = 2 * math.pi * frequency / complex(body.sound_speed)
    assert body.is_lossy
    assert inner.imag > 0
    # Miki's impedance and wavenumber
    times = (1000 * ratio) ** np.array([-0.632, -0.618])
    impedance, wavenumber = 1 + (5.50 + 8.43j) * times[0], 1 + (7.81 + 11.41j) * times[1]
    assert body.density * body.sound_speed / (density * 343.0) == pytest.approx(impedance, rel=1e-2)
    assert 343.0 / body.sound_speed == pytest.approx(wavenumber, rel=1e-2)  # both forms have three digits


def test_porous_materials_say_their_range():
    with pytest.raises(ValueError, match=r"must be in 40000 to 4e\+06 at 40000 Hz"):
        at.porous(10e3)
    with pytest.raises(TypeError, match="did you mean 'flow_resistivity'"):
        at.porous(flow_resistance=200e3)


def test_scene_names_and_tells_materials_apart():
    bodies = [box(**FOAM), box(**ABSORBING), box(impedance=2.0), box(impedance=2 + 1j), box(rigid=True)]
    assert len({digest_of(body) for body in bodies}) == len(set(bodies)) == 5
    with pytest.warns(at.OverlapWarning, match=r"1 overlaps 0.*4 overlaps 3"):
        text = scene_of(*bodies)._repr_html_()
    for part in ("1.7+1.1j kg/m³, 239-80j m/s", "1500 m/s, 40 dB/m", "impedance 2+1j", "rigid"):
        assert part in text
    assert not scene_of(bodies[2]).equals(scene_of(bodies[3]))
    assert not box(rigid=True).is_lossy
    assert not box(impedance=2j).is_lossy
    assert replace(bodies[3], center=(0, 0, 0.11)).impedance == 2 + 1j
    cleared = box(density=AIR.density, sound_speed=AIR.sound_speed)  # of the medium: points may lie inside
    assert scene_of(replace(cleared, center=(0, 0, 0.15)))
    with pytest.raises(ValueError, match="lies in or on obstacle 0"):
        scene_of(replace(cleared, center=(0, 0, 0.15), absorption=1.0))


def test_materials_are_saved_and_read(tmp_path):
    apart = (0.0, 0.05, 0.05)
    scene = scene_of(box(**FOAM), at.Sphere(apart, 4e-3, impedance=1.5 - 1j), medium=at.Medium.air())
    at.save_scene(tmp_path / "scene.yaml", scene)
    assert "impedance: 1.5-1j\n" in (tmp_path / "scene.yaml").read_text()
    assert at.load_scene(tmp_path / "scene.yaml").equals(scene)
    made = {}
    exec(scene_lines(scene, at.drive_from_phases([0.0] * 4), "scene"), made)
    assert made["scene"].equals(scene)


def section(**material):
    return {
        "medium": {"temperature": 25.0},
        "frequency": 30e3,
        "array": {"type": "positions", "positions": [[0, 0, 0]], "normals": [0, 0, 1]},
        "control_points": {"type": "points", "positions": [[0, 0, 0.15]]},
        "obstacles": [{"type": "box", "center": [0, 0, 0.1], "size": [0.05, 0.05, 0.01]} | material],
    }


def test_scene_files_have_porous_materials_and_complex_numbers():
    (body,) = at.load_scene(section(porous={"flow_resistivity": 200e3})).obstacles
    assert body == box(**at.porous(200e3, 30e3, at.Medium.air(25.0, frequency=30e3)))
    (body,) = at.load_scene(section(impedance="1.5 - 1j")).obstacles
    assert body == box(impedance=1.5 - 1j)
    (body,) = at.load_scene(section(**ABSORBING)).obstacles
    assert body == box(**ABSORBING)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ({"porous": {"flow": 1}}, r"obstacles\[0\].porous: unknown key 'flow'"),
        ({"porous": 3}, r"obstacles\[0\].porous: 3; must be a mapping"),
        (
            {"porous": {"flow_resistivity": 1}},
            r"flow_resistivity: 1 Pa .* must be in 30000 to 3e\+06 at 30000",
        ),
        ({"porous": {"flow_resistivity": 2e5}, "density": 1}, r"density: 1; must be absent beside porous"),
        ({"impedance": "soft"}, r"obstacles\[0\].impedance: 'soft'; must be a number such as 1.5 or"),
    ],
)
def test_bad_materials_in_scene_files_are_named(material, message):
    with pytest.raises(ValueError, match=message):
        at.load_scene(section(**material))


def test_region_has_the_materials_at_the_frequency():
    region = region_of(scene_of(box(**FOAM)))
    assert region.bodies[0].fluid == (1.7 + 1.1j, 239 - 80j)
    density, speed = region_of(scene_of(box(**ABSORBING))).bodies[0].fluid
    inner = 2 * math.pi * 40e3 / speed
    assert density == 1000.0
    assert inner.real == pytest.approx(2 * math.pi * 40e3 / 1500.0, rel=1e-12)
    assert 20 * math.log10(math.exp(inner.imag)) == pytest.approx(40.0, rel=1e-12)  # over 1 m
    (body,) = region_of(scene_of(box(impedance=2 + 1j))).bodies
    assert (body.fluid, body.impedance) == (None, 2 + 1j)
    (body,) = region_of(scene_of(box(density=1.3, sound_speed=300.0))).bodies
    assert isinstance(body.fluid.density, float)
    assert isinstance(body.fluid.sound_speed, float)


def test_foam_is_not_taken_as_rigid():
    # Air hardly moves in the densest foam, but its sound speed is low.
    foam = at.porous(4e6)
    assert abs(foam["density"]) > 10
    (body,) = with_rigid(region_of(scene_of(box(**foam))), 0.05).bodies
    assert body.fluid is not None
    (body,) = with_rigid(region_of(scene_of(box(**ABSORBING))), 0.05).bodies
    assert body.fluid is None
