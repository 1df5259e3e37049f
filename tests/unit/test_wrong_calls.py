"""Calls that newcomers get wrong: a line names the field and the fix, or the call is right."""

import inspect
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at
from autdtorch import hardware
from autdtorch.utils.hints import did_you_mean

FOCI = at.circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0))
ARRAY = at.TransducerArray.grid((4, 4), 10e-3, (1e-3, 50e-3, 50e-3))
AIR = at.Medium(1.293, 340.0)
PLANE = at.Plane((80e-3, 50e-3, 50e-3), (1, 0, 0), (0.1, 0.1))
MAP = np.ones((4, 4))
PHASES = np.linspace(0, 3, 16)
MIDDLE = (41e-3, 50e-3, 50e-3)


def box(**changes):
    return at.Box(**{"center": MIDDLE, "size": (16e-3,) * 3, "rigid": True} | changes)


def scene(*obstacles, **changes):
    parts = {"array": ARRAY, "medium": AIR, "frequency": 40e3, "control_points": FOCI, "obstacles": obstacles}
    return at.Scene(**parts | changes)


def grid(x=1e-3, normal=(1, 0, 0), pitch=10e-3, **other):
    return at.TransducerArray.grid((4, 4), pitch, (x, 50e-3, 50e-3), normal, **other)


def facing(x, normal, *obstacles, **other):
    return scene(*obstacles, array=grid(x, normal, radius=4e-3), **other)


def wall(x=0.2, size=(0.05, 10.0, 10.0), **changes):
    return box(center=(x, 50e-3, 50e-3), size=size, **changes)


def room(*reflectors, obstacles=(), **changes):
    return scene(*obstacles, reflectors=reflectors, **changes)


def wall_at(x, normal=(1, 0, 0), reflection=1.0, y=0.0):
    return at.Reflector((x, y, 0), normal, reflection)


@pytest.fixture(scope="module")
def objective():
    free = scene()
    return at.SimulatedObjective(free, at.make_propagator(free))


SECTION = {
    "medium": {"density": 1.293, "sound_speed": 340.0},
    "array": {"type": "grid", "shape": [4, 4], "pitch": 10e-3, "center": [1e-3, 50e-3, 50e-3]},
    "control_points": {"type": "points", "positions": FOCI.tolist()},
}
WARNED = {
    "rotation=45": (lambda: box(rotation=(0, 0, 45)), r"Box\.rotation.*degrees.*rotation_degrees=\(0, 0, 45"),
    "rotation=-180": (lambda: box(rotation=(-180, 0, 0)), r"Box\.rotation.*degrees"),
    "moved scene": (lambda: facing(0.2, (1, 0, 0)).moved((0, 0, 1e-3)), "control_points.*behind"),
    "replaced": (lambda: replace(scene(), frequency=40.0), "frequency in Hz"),
    "replaced box": (lambda: replace(box(), rotation=(0, 0, 45)), "rotation_degrees"),
    "file": (lambda: at.load_scene(SECTION | {"frequency": 40.0}), "frequency in Hz"),
    "moved": (lambda: scene(box()).moved(rotation=(0, 0, 20)), r"rotation.*rotation_degrees"),
    "angle=90": (lambda: at.TransducerArray.autd3((0, 0, 0), angle=90), r"angle.*math\.radians\(90\)"),
    "circle": (lambda: at.circle_points(MIDDLE, 0.03, 4, (1, 0, 0), 45), "angle.*degrees"),
    "phases": (lambda: at.drive_from_phases([0, 90, 180, 270]), "phases.*degrees"),
    "mm of size": (lambda: scene(box(size=(0.01, 20, 0.01), center=(0.04, 20, 0.05))), "obstacles.*in m"),
    "mm of both": (lambda: scene(box(center=(41, 50, 50), size=(16,) * 3)), r"obstacles\[0\].*in m"),
    "mm of center": (lambda: scene(at.Sphere((41, 50, 50), 8e-3, rigid=True)), r"obstacles\[0\].*in m"),
    "mm of domain": (lambda: scene(domain=((0, 0, 0), (100, 100, 100))), r"Scene\.domain.*in m"),
    "mm of plane": (lambda: scene(observation_plane=replace(PLANE, size=(9, 9))), "observation_plane.*in m"),
    "phase levels": (lambda: at.drive_from_phases(np.arange(0, 256, 16)), "phases.*levels of a device"),
    "kHz of 1 m": (lambda: scene(frequency=40.0, control_points=[(1, 0.05, 0.05)]), "frequency in Hz"),
    "kHz": (lambda: scene(frequency=40.0), "frequency in Hz, 40 kHz as 40e3"),
    "humidity": (lambda: at.Medium.air(20, 0.5), "relative_humidity.*50"),
    "other air": (lambda: scene(medium=at.Medium.air(frequency=25e3)), "Scene.medium.*frequency=40000"),
    "mm of wall": (lambda: scene(wall(200.0, (50.0, 600.0, 400.0))), r"obstacles\[0\].*in m"),
    "mm/s": (lambda: at.Medium(1.2, 340e3), "sound_speed.*other units"),
    "swapped": (lambda: at.Medium(340.0, 1.2), "sound_speed.*swapped"),
    "mm of a reflector": (lambda: room(wall_at(-200.0)), r"reflectors\[0\].*m from everything.*in m"),
    "points that face away": (lambda: scene(array=grid(0.2)), "control_points.*behind.*normal"),
    "MHz": (lambda: scene(frequency=40e6), "frequency in Hz"),
    "mm of pitch": (lambda: scene(array=grid(1e-3, pitch=10)), "array.*10 m apart.*in m"),
    "cm of all": (lambda: scene(array=grid(0.1, pitch=1.0), control_points=100 * FOCI), "1 m apart.*in m"),
    "mm of all": (lambda: scene(array=grid(1.0, pitch=10.0), control_points=1e3 * FOCI), "lengths in m"),
    "cm of foci": (lambda: scene(control_points=100 * FOCI), "points: 9.596 m from an array of.*in m"),
    "g/cm^3": (lambda: scene(obstacles=[at.Sphere(MIDDLE, 8e-3, density=8, sound_speed=5e3)]), r"0\].dens"),
    "g/cm^3 of a bead": (lambda: at.Particle(1e-3, 1.05, 2350.0), r"Particle\.density.*1 g/cm\^3"),
    "g/cm^3 of water": (lambda: at.Medium(1.0, 1482.0), r"Medium\.density.*1 g/cm\^3"),
    "behind": (lambda: facing(0.2, (1, 0, 0)), "control_points.*behind.*normal"),
    "turned away": (lambda: facing(1e-3, (-1, 0, 0)), "control_points.*behind.*normal"),
}


@pytest.mark.parametrize("name", WARNED)
def test_what_is_possible_but_seldom_meant_is_told_at_the_line_of_the_caller(name):
    call, message = WARNED[name]
    with pytest.warns(at.ScaleWarning, match=message) as caught:
        call()
    assert {one.filename for one in caught} == {__file__}


def lone(focus, **changes):
    """Return a scene of one point source and a focus that far [m]."""
    array = at.TransducerArray([(0, 0, 0)], (1, 0, 0))
    return at.Scene(
        **{"array": array, "medium": AIR, "frequency": 40e3, "control_points": [(focus, 0, 0)]} | changes
    )


def in_water(frequency):
    tank = wall(0.02, (0.01, 0.6, 0.4))
    points = [(0.01, 0.05, 0.05)]
    array, water = grid(0, pitch=1e-3), at.Medium(998.0, 1482.0)
    return at.Scene(array, water, frequency, points, [tank])


def moved_and_read():
    tall = scene(wall())
    tall.moved((0, 0, 20e-3))
    replace(tall, frequency=41e3)
    domain = dict(zip(("lower", "upper"), tall.domain, strict=True))
    same = {"type": "box", "center": [0.2, 0.05, 0.05], "size": [0.05, 10.0, 10.0], "rigid": True}
    at.load_scene(SECTION | {"frequency": 40e3, "domain": domain, "obstacles": [same]})


NEAR = {"control_points": [(0.1, 0.05, 0.05)]}
MEANT = {
    "turns": lambda: box(rotation=(math.pi, -math.pi, 2 * math.pi)),
    "two turns in degrees": lambda: replace(box(rotation_degrees=(0, 0, 720)), rigid=True),
    "a loop over turns": lambda: [
        scene(box()).moved(rotation=(0, 0, turn)) for turn in (7, 2.2 * math.pi, 12.1)
    ],
    "a wall of 1 m": lambda: scene(wall(0.65, (1.0,) * 3), medium=at.Medium.air(), **NEAR),
    "a wall of 5 m": lambda: scene(wall(size=(0.05, 5.0, 3.0)), **NEAR),
    "a table": lambda: scene(wall(size=(0.02, 2.0, 1.0)), frequency=60e3, **NEAR),
    "a wall without end": lambda: [scene(wall(size=(0.05, wide, wide)), **NEAR) for wide in (10, 100, 1e4)],
    "a hall": lambda: scene(wall(6.0, (0.1, 12.0, 8.0)), wall(-6.0, (0.1, 12.0, 8.0)), **NEAR),
    "a tank at 1 MHz": lambda: in_water(1e6),
    "a tank at 2 MHz": lambda: in_water(2e6),
    "a plane of 3 m": lambda: scene(observation_plane=replace(PLANE, size=(3, 3))),
    "a domain of 3 m": lambda: scene(domain=((-1.5,) * 3, (1.5,) * 3)),
    "a hand on the panel": lambda: room(
        at.Reflector.behind(ARRAY), obstacles=[at.Sphere((1e-3, 0, 0), 8e-3, rigid=True)]
    ),
    "a wall of the lab": lambda: room(wall_at(-2.0), wall_at(3.0, (-1, 0, 0))),
    "a scene that is moved, replaced, read": moved_and_read,
    "some foci behind": lambda: facing(1e-3, (1, 0, 0), control_points=at.sphere_points(MIDDLE, 0.1, 9)),
    "sources without direction": lambda: lone(-0.05),
    "foci that a wall reflects": lambda: facing(0.2, (1, 0, 0), wall(0.4)),
    "a loudspeaker in a hall": lambda: lone(20.0),
    "foci of a loudspeaker": lambda: scene(control_points=[(4.9, 0.05, 0.05)]),
    "gases and foam": lambda: [at.Medium(*each) for each in ((0.17, 1e3), (0.084, 1300.0), (20.0, 900.0))],
    "a focus at 1 cm of 3 kHz": lambda: lone(0.01, frequency=3e3),
    "a loudspeaker of 500 Hz": lambda: lone(0.3, frequency=500.0),
    "no units": lambda: lone(2.0, medium=at.Medium(1, 1), frequency=1.0),
    "air of nearly this frequency": lambda: scene(medium=at.Medium.air(frequency=40.1e3)),
    "an absorption": lambda: scene(frequency=25e3, medium=replace(at.Medium.air(), absorption=0.5)),
    "phases": lambda: at.drive_from_phases(at.focus_phases(ARRAY.positions, FOCI[0], 739.2)),
    "whole phases": lambda: at.drive_from_phases(torch.arange(16)),
}


@pytest.mark.parametrize("name", MEANT)
def test_what_is_meant_is_not_told(name):
    MEANT[name]()  # a warning would be an error


@pytest.mark.parametrize("part", ["obstacle", "plane", "domain"])
def test_each_cause_is_told_once(part):
    sphere, plane = at.Sphere((41, 50, 50), 8e-3, rigid=True), replace(PLANE, size=(100, 100))
    more = {
        "obstacle": {"obstacles": [sphere], "domain": ((-1,) * 3, (100,) * 3)},
        "plane": {"observation_plane": plane, "domain": ((-100,) * 3, (100,) * 3)},
        "domain": {"domain": ((-100,) * 3, (100,) * 3)},
    }
    with pytest.warns(at.ScaleWarning, match=part) as caught:
        scene(**more[part])
    assert len(caught) == 1


@given(degrees=st.tuples(*[st.floats(-1080, 1080)] * 3))
def test_degrees_are_radians_in_the_end(degrees):
    turned = box(rotation_degrees=degrees)
    for radians, meant in zip(turned.rotation, degrees, strict=True):
        assert abs(radians) <= math.pi
        assert math.remainder(math.degrees(radians) - meant, 360) == pytest.approx(0, abs=1e-9)
    assert replace(turned, center=(0, 0, 0)).rotation == turned.rotation
    assert replace(turned, rigid=True).rotation == turned.rotation
    moved = scene(box()).moved(rotation=turned.rotation)
    assert scene(box()).moved(rotation_degrees=degrees).obstacles == moved.obstacles


REFUSED = {
    "both": (lambda _: box(rotation=(0, 0, 1), rotation_degrees=(0, 0, 45)), "rotation_degrees.*rotation,"),
    "size in it": (lambda _: scene(box(size=(20, 20, 20))), "obstacle 0.*in m, 16 mm as 16e-3"),
    "path": (lambda _: at.make_propagator("two_cubes.yaml"), r"scene.*load_scene\(path\)"),
    "phases": (lambda seen: seen(PHASES), r"drive.*complex.*drive_from_phases\(phases\)"),
    "amplitudes_of": (lambda _: at.amplitudes_of(PHASES), "drive.*drive_from_phases"),
    "name": (lambda seen: at.run("gabs", seen), r"method.*GABS\(\)"),
    "wrong name": (lambda seen: at.run("lsg", seen), "method.*such as LSSG\\("),
    "function": (lambda seen: at.run(at.identify, seen), r"method.*Identify\(\)"),
    "class": (lambda seen: at.run(at.BayesOpt, seen), r"method.*BayesOpt\(\)"),
    "scene": (lambda seen: at.run(at.GABS(), seen.scene), r"objective.*SimulatedObjective\(scene"),
    "device": (lambda _: hardware.open_link("autd3"), r"device.*hardware\.AUTD3.*open_autd3\(\)"),
    "near device": (lambda _: hardware.open_link("ultrano"), r"such as hardware\.ULTRAINO$"),
    "capitals": (lambda _: at.Holography("GS"), "algorithm.*did you mean 'gs'"),
    "sphere": (
        lambda _: at.analytic.rigid_sphere(FOCI, ARRAY.positions, 739 + 1j, MIDDLE, 0.01),
        r"wavenumber.*real.*scene\.wavenumber",
    ),
    "kHz in damp air": (lambda _: scene(frequency=40.0, medium=at.Medium.air()), r"Scene\.frequency.*40e3\?"),
    "a medium that no wave crosses": (
        lambda _: scene(medium=at.Medium(1.2, 340.0, absorption=400.0)),
        r"Scene\.medium\.absorption.*352.9 dB/m",
    ),
    "maps": (lambda _: at.plot_planes({"a": {"b": MAP}}, PLANE), "pressure.*by name"),
    "map": (lambda _: at.plot_planes(MAP, PLANE), "pressure.*plot_plane"),
}


PANEL = at.Reflector.behind(ARRAY)
REFUSED |= {
    "foam too dense": (lambda _: at.porous(1e9, frequency=40e3), r"flow_resistivity: 1000000000\.0 .*in 4"),
    "more than all reflected": (lambda _: wall_at(0, reflection=1.5), r"reflection: 1\.5; its magnitude"),
    "a normal of nothing": (lambda _: wall_at(0, (0, 0, 0)), r"normal: \(0, 0, 0\).*length"),
    "array behind": (lambda _: room(wall_at(2e-3)), r"array\.positions\[0\].*1 mm behind.*its normal points"),
    "a normal turned away": (
        lambda _: room(wall_at(1e-3, (-1, 0, 0))), r"control_points\[.*79 mm behind.*its normal",
    ),
    "points behind": (lambda _: room(wall_at(40e-3, (-1, 0, 0))), r"control_points.*40 mm behind refl"),
    "plane behind": (
        lambda _: room(PANEL, observation_plane=at.Plane(MIDDLE, (0, 0, 1), (0.1, 0.1))),
        r"observation_plane corner\[\d\].*mm behind reflector 0",
    ),
    "obstacle behind": (
        lambda _: room(PANEL, obstacles=[box(center=(-30e-3, 0, 0))]),
        r"obstacles\[0\]: \(.*\) m; is wholly behind reflector 0, must be in front",
    ),
    "planes too near": (
        lambda _: room(PANEL, wall_at(5e-3, (-1, 0, 0))), r"\[1\]\.point.*0\.004 m in front.*wavelength",
    ),
    "planes back to back": (
        lambda _: room(PANEL, wall_at(-1, (-1, 0, 0))), r"\[1\]\.point.*1\.001 m behind.*must",
    ),
    "planes at 60 degrees": (lambda _: room(PANEL, wall_at(-1, (1, 2, 0))), r"\[1\]\.normal.*right angle"),
    "planes of one direction": (lambda _: room(PANEL, wall_at(-1)), r"\[1\]\.normal.*be against"),
    "a tilted plane in full": (
        lambda _: at.make_propagator(room(wall_at(-0.1, (1, 0.1, 0))), method="full"), "'full'.*along an a",
    ),
    "half reflected in full": (
        lambda _: at.make_propagator(room(wall_at(0, reflection=0.5)), method="full"), "'full'.*1 or -1.*box",
    ),
    "half reflected under an obstacle": (
        lambda _: at.make_propagator(room(wall_at(0, reflection=0.5), obstacles=[box(center=(8e-3, 0, 0))])),
        r"reflectors\[0\]\.reflection: 0\.5; must be 1 or -1 where an obstacle",
    ),
    "a mapping": (lambda _: room({"point": (0, 0, 0), "normal": (1, 0, 0)}), r"reflectors\[0\].*a Reflector"),
    "no list": (lambda _: scene(reflectors=PANEL), r"reflectors.*sequence, each entry of class Reflector"),
    "two boards": (lambda _: at.Reflector.behind(ARRAY + grid(0.2, (-1, 0, 0))), "array.*flat array"),
    "heard behind": (
        lambda _: at.make_propagator(room(PANEL)).field(torch.ones(16) + 0j, [(0, 0.05, 0.05)]),
        r"points\[0\].*1 mm behind reflector 0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_refusal_names_field_and_fix_in_a_line(name, objective):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message) as caught:
        call(objective)
    assert "\n" not in str(caught.value)


def test_an_equal_scene_serves_and_another_does_not(objective):
    assert at.SimulatedObjective(scene(name="again"), at.make_propagator(scene())).scene.equals(scene())
    for other in (
        scene(box()),
        scene(frequency=41e3),
        scene(control_points=FOCI[:3]),
        facing(2e-3, (1, 0, 0)),
    ):
        assert not scene().equals(other)
        with pytest.raises(ValueError, match="must be the propagator's scene"):
            at.SimulatedObjective(other, at.make_propagator(scene()))


def test_matrix_and_objective_serve_alike(objective):
    G = objective.transfer_matrix
    torch.testing.assert_close(at.holography(objective), at.holography(G), rtol=0, atol=0)
    ours, theirs = (at.gradient_ascent(source, starts=2, steps=20) for source in (G, objective))
    torch.testing.assert_close(ours.drive, theirs.drive, rtol=0, atol=0)
    torch.testing.assert_close(ours.pressure, theirs.pressure)  # one sum is of complex, one of real numbers


def test_maps_of_one_plane_are_those_of_one_scene():
    one = at.plot_planes({"a": MAP, "b": 2 * MAP}, PLANE, FOCI, [box()])
    named = at.plot_planes({"s": {"a": MAP, "b": 2 * MAP}}, {"s": PLANE}, {"s": FOCI}, {"s": [box()]})
    values = [
        [mesh.get_array() for ax in figure.axes for mesh in ax.collections if mesh.get_array() is not None]
        for figure in (one, named)
    ]
    assert len(values[0]) > 1
    for ours, theirs in zip(*values, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_air_cut_from_a_body_later_is_air():
    hollow = box(size=(30e-3,) * 3), box(size=(10e-3,) * 3, rigid=False, density=1.293, sound_speed=340.0)
    with pytest.warns(at.OverlapWarning):
        scene(*hollow, control_points=[MIDDLE])
    for obstacles in (hollow[::-1], (*hollow, box(size=(5e-3,) * 3))):
        with pytest.raises(ValueError, match="lies in or on obstacle"):
            scene(*obstacles, control_points=[MIDDLE])
    wall = (MIDDLE[0] + 5e-3, *MIDDLE[1:])
    with pytest.raises(ValueError, match="lies in or on obstacle 0"):
        scene(*hollow, control_points=[wall])


KEYWORDS = {
    "metod": (lambda seen: at.make_propagator(seen.scene, metod="box"), "method"),
    "spcing": (lambda seen: at.make_propagator(seen.scene, spcing=1e-3), "spacing"),
    "centre": (lambda _: box(centre=MIDDLE), "center"),
    "rotation_deg": (lambda _: box(rotation_deg=(0, 0, 45)), "rotation_degrees"),
    "control_point": (lambda _: at.Scene(ARRAY, AIR, 40e3, control_point=FOCI), "control_points"),
    "level": (lambda seen: at.gabs(seen, level=8), "levels"),
    "trails": (lambda seen: at.run(at.LSS(), seen, trails=3), "trials"),
    "decibel": (lambda _: at.plot_plane(MAP, PLANE, decibel=True), "decibels"),
    "humidity": (lambda _: at.Medium.air(20, humidity=50), "relative_humidity"),
    "unit": (lambda _: at.TransducerArray.autd3((0, 0, 0), unit=(2, 1)), "units"),
    "fields": (lambda _: at.view3d(scene(), fields={}), "field"),
    "quantity": (lambda _: at.plot_trials(quantity={}), "quantities"),
    "file_path": (lambda _: at.save_scene(scene(), file_path="a.yaml"), "path"),
}


@pytest.mark.parametrize("name", KEYWORDS)
def test_a_wrong_keyword_brings_the_right_one(name, objective):
    call, right = KEYWORDS[name]
    with pytest.raises(TypeError, match=rf"keyword argument '.*\(did you mean '{right}'\?\)$"):
        call(objective)


def test_a_keyword_like_no_other_brings_all_and_errors_further_in_stay():
    with pytest.raises(TypeError, match=r"'diameter'; keywords: center, radius, .*\brigid\b"):
        at.Sphere(MIDDLE, diameter=1.0, rigid=True)

    def outer(alpha=1):
        return inner(beta=alpha)

    def inner(gamma=1): ...

    with pytest.raises(TypeError, match=r"inner\(\) got an unexpected keyword argument 'beta'$"):
        outer(2)


@pytest.mark.parametrize("package", [at, hardware])
def test_every_public_function_answers_a_wrong_keyword(package):
    functions = [one for one in map(package.__getattr__, package.__all__) if inspect.isfunction(one)]
    assert functions
    for function in functions:
        assert pickle.loads(pickle.dumps(function)) is function
        with pytest.raises(TypeError, match=r"keyword argument 'zzqy'(; keywords: | \(did you mean)"):
            function(zzqy=1)


@pytest.mark.parametrize(
    ("package", "name", "right"), [(at, "makepropagator", "make_propagator"), (hardware, "AUDT3", "AUTD3")]
)
def test_a_wrong_name_brings_the_right_one(package, name, right):
    with pytest.raises(AttributeError, match=f"{name}.*did you mean '{right}'"):
        getattr(package, name)


@given(name=st.sampled_from(at.__all__), place=st.integers(0, 30), letter=st.sampled_from("xyz_"))
def test_one_wrong_letter_finds_the_name(name, place, letter):
    wrong = f"{name[: place % len(name)]}{letter}{name[place % len(name) :]}"
    if len(name) > 4 and wrong not in at.__all__:
        assert repr(name) in did_you_mean(wrong, at.__all__)


def test_one_is_singular():
    single = at.Scene(at.TransducerArray([(0, 0, 0)], (1, 0, 0)), AIR, 40e3, [(0.05, 0, 0)], [box()])
    assert "1 transducer, 1 control point, 1 obstacle," in repr(single)
    assert "16 transducers, 4 control points, 0 obstacles" in repr(scene())
