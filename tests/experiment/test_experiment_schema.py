import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Union, get_args, get_origin

import pytest
from experiment_files import QUICK, SPRING, SPRING_STRUCTURE, write_quick, write_spring
from places import EXPERIMENTS
from pydantic import BaseModel

import gbid.experiment
from gbid.core.errors import UsageError
from gbid.experiment.experiment import figure_pairs, validation_pairs
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import _parse, _without, experiment_json_schema, load_experiment
from gbid.experiment.machine import rig_run
from gbid.experiment.schema import ExperimentFile
from gbid.rig import PiezoStacks


def problems_of(path: Path) -> list[str]:
    with pytest.raises(ExperimentError) as caught:
        load_experiment(path)
    for problem in caught.value.problems:
        assert problem.position.startswith(f"{path}:")
    return [str(p).removeprefix(f"{path}:") for p in caught.value.problems]


def place_of(text: str, needle: str) -> str:
    """Line and column, from 1, of a piece of text."""
    before = text[: text.index(needle)]
    return f"{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}"


def test_experiments_plan_their_recordings_and_pairs(tmp_path):
    spring = load_experiment(write_spring(tmp_path / "spring"))
    assert spring.recordings["run1"].signals == {"u": ("u",), "y": ("1",)}
    assert figure_pairs(spring, "spring") == [("run1", "run2"), ("run2", "run1")]
    experiment = load_experiment(write_quick(tmp_path))
    assert list(experiment.recordings) == ["p5_n6000_still1", "p5_n6000_prbs1", "p5_n6000_prbs2"]
    assert [q.excited for q in experiment.recordings.values()] == [False, True, True]
    assert experiment.results == tmp_path / "results" / "quick"
    assert load_experiment(tmp_path / "experiment.yaml", tmp_path / "elsewhere").results == tmp_path / "elsewhere"
    assert validation_pairs(experiment, "bearing") == [
        ("p5_n6000_prbs1", "p5_n6000_prbs2"),
        ("p5_n6000_prbs2", "p5_n6000_prbs1"),
    ]


def test_numbers_of_yaml_1_2_are_numbers(tmp_path):
    path = write_quick(tmp_path, ("noise_p_m: 30e-9", "noise_p_m: 30e-9, offset_p_m: [1e-6, -2.5E-6]"))
    rig = load_experiment(path).spec.rig
    assert rig.prbs.amplitude_m == 4.5e-6
    assert rig.prbs.hold_s == 0.02
    assert rig.sensors.noise_p_m == 3e-8
    assert rig.sensors.offset_p_m == (1e-6, -2.5e-6)
    assert rig.operating_points[0].speed_rpm == 6000.0


LEFT_OUT = "left_out: {p5_n6000_prbs1: [[0.1, 0.2]]}"


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("harmonics: 6", "harmonic: 6", "harmonic: 6", ["prefilter.harmonic", "did you mean 'harmonics'"]),
        ("prefilter:", "prefiltre:", "prefiltre:", ["unknown key", "did you mean 'prefilter'"]),
        ("seed: 3", "seed: three", "seed: three", ["rig.seed", "whole number", "'three'"]),
        ("4.5e-6", "4.5 um", "amplitude_m: 4.5 um", ["rig.prbs.amplitude_m", "a number without unit"]),
        ("4.5e-6", "-1.0e-6", "amplitude_m: -1.0e-6", ["above 0", "-1e-06"]),
        ("30e-9", "[1e-9, 1e-9, 1e-9]", "noise_p_m: [", ["two of them for x and y"]),
        ("30e-9", ".nan", "noise_p_m: .nan", ["finite number", "nan"]),
        ("stop: paper", "stop: papper", "stop: papper", ["fits.bearing.stop", "'tolerance' or 'paper'", "'papper'"]),
        ("stop: paper", "window: once", "window: once", ["fits.bearing.window", "the word auto or one", "'once'"]),
        ("stop: paper", "prior: {tau_x: {value: 1e-3}}", "tau_x: {value", ["prior.tau_x.std", "is missing"]),
        ("stop: paper", "trend: cubic", "trend: cubic", ["expected none, offset, linear, random walk, or a degree"]),
        ("stop: paper", "trend: {p_z: 2}", "trend: {p_z", ["trend names 'p_z'", "they are p_x, p_y"]),
        ("stop: paper", "hum: [50, 50.0]", "hum: [50", ["given twice"]),
        ("stop: paper", "initial_state: nought", "initial_state: nought", ["estimated, zero or structure", "'nought'"]),
        ("stop: paper", "left_out: {p5_n6000_prbs1: 3}", "p5_n6000_prbs1: 3", ["left_out.p5_n6000_prbs1", "a list"]),
        ("stop: paper", "start: dta", "start: dta", ["or the word data, found 'dta'"]),
        ("stop: paper", "start: {tau_x: a}", "start: {tau_x", ["or the word data, found {'tau_x': 'a'}"]),
        ("stop: paper", "criterion: tr", "criterion: tr", ["expected 'trace' or 'det' or 'auto', found 'tr'"]),
        ("4.5e-6", "4.5e-6, extra: 1", "extra: 1", ["unknown key; choose from recordings, amplitude_m, hold_s"]),
        ("name: quick", "name: 2024", "name: 2024", ["name", "text", "quotes"]),
        ("name: quick", "name: a/b", "name: a/b", ["'a/b' cannot be a name"]),
        ("format: 1", "format: 2", "format: 2", ["format", "expected 1", "found 2"]),
        ("prefilter:\n  harmonics: 6", "prefilter:", "prefilter:", ["is empty", "{}"]),
        # meaning
        ("speed_rpm: 6000", "speed_rpm: 8000", "speed_rpm: 8000", ["operating_points[0].speed_rpm", "0 to 6000"]),
        ("seed: 3", "model: nosuch", "model: nosuch", ["no model 'nosuch'", "theisen2016"]),
        ("20e-3", "20.05e-3", "hold_s: 20.05e-3", ["rig.prbs.hold_s", "whole number of samples"]),
        ("{recordings: 1}", "{recordings: 0}", "prefilter:", ["no stationary recording at p5_n6000"]),
        ("harmonics: 6", "median: 4", "median: 4", ["4 is even"]),
        ("4.5e-6", "4.5", "amplitude_m: 4.5", ["rig.prbs.amplitude_m", "4.5 m is more than the clear", "2.5e-05 m"]),
        ("30e-9", "[30e-9, 30e-6]", "noise_p_m: [30e-9", ["rig.sensors.noise_p_m", "3e-05 m is more than the clear"]),
        ("piezo_pair", "piezo_pairs", "structure: piezo_pairs", ["did you mean 'piezo_pair'", "file.py:name"]),
        ("piezo_pair}", "piezo_pair, options: {pade_order: 2}}", "options: {pade", ["no option pade_order"]),
        ("stop: paper", "start: {k_x: 1}", "k_x: 1", ["fits.bearing.start.k_x", "did you mean 'k_yx'"]),
        ("stop: paper", "bounds: {tau_x: [1, 0]}", "tau_x: [1", ["lower = 1.0 must be below upper = 0.0"]),
        ("stop: paper", "start: {tau_x: 1.0}", "tau_x: 1.0", ["outside its bounds"]),
        ("stop: paper", "fixed: {tau_x: 1e-3}, prior: {tau_x: {value: 1e-3, std: 1}}", "tau_x: {v", ["is fixed"]),
        ("stop: paper", "prior: {offset_p_x: {value: 0, std: 1}}", "offset_p_x", ["no parameter of rotor_bearing"]),
        ("piezo_pair}", "piezo_pair, together: true, local: {p1: recording}}", "p1: rec", ["local.p1", "no parameter"]),
        ("stop: paper", "local: {tau_x: recording}", "local: {", ["write together: true"]),
        ("stop: paper", "output_weights: [1, 1, 1]", "output_weights", ["3 weights for 2 outputs: p_x, p_y"]),
        ("stop: paper", "criterion: det, output_weights: [1, 2]", "output_weights", ["criterion: trace"]),
        ("stop: paper", "initial_state: [0, 0]", "initial_state", ["has shape (2,); the structure has 4 states"]),
        ("stop: paper", "initial_state: structure", "initial_state", ["states none; add x0 to its matrices(p)"]),
        ("stop: paper", "initial_state: {p9: zero}", "initial_state", ["give one for each recording of the fit"]),
        ("stop: paper", "focus: simulation, prior: {bd_xx: {value: 0, std: 1}}", "bd_xx", ["does not use"]),
        ("stop: paper", LEFT_OUT.replace("prbs1", "prbs7"), "p5_n6000_prbs7", ["did you mean 'p5_n6000_prbs2'"]),
        ("stop: paper", LEFT_OUT.replace("0.1, 0.2", "0.9, 1.1"), "[0.9, 1.1]", ["beyond the end of the recording"]),
        ("gain: diagonal", "gain: none, delay: exact, pade_order: 2", "options: {", ["pade_order is for delay"]),
        ("stop: paper", "recordings: p6*", "recordings: p6*", ["no recording matches 'p6*'"]),
        ("stop: paper", "inputs: w", "inputs: w", ["has no signal 'w'"]),
        ("stop: paper", "outputs: p.z", "outputs: p.z", ["has no channel 'z'"]),
        ("bearing: {on: cyclic", "bearings: {on: cyclic", "bearings: {on", ["did you mean 'bearing'"]),
        ("on: cyclic", "on: [p9]", "on: [p9]", ["no recording matches 'p9'"]),
        ("recordings: 2", "recordings: 1", "on: cyclic", ["no other recording for 'p5_n6000_prbs1'"]),
        ("stop: paper", "together: true", "on: cyclic", ["cyclic needs a fit per recording"]),
        ("to_s: 0.4", "to_s: 0.1", "to_s: 0.1", ["not after from_s"]),
        ("from_s: 0.2, to_s: 0.4", "from_s: 2.0", "from_s: 2.0", ["beyond the end"]),
    ],
)
def test_form_and_meaning_are_checked_with_position(tmp_path, old, new, place, words):
    path = write_quick(tmp_path, (old, new))
    (line,) = problems_of(path)
    assert line.startswith(place_of(QUICK.replace(old, new), place) + ": ")
    for word in words:
        assert word in line


def test_all_problems_at_once_in_the_order_of_the_file(tmp_path):
    path = write_quick(
        tmp_path, ("seed: 3", "sed: 3"), ("harmonics: 6", "median: 2.5"), ("stop: paper", "focus: sharp")
    )
    assert [line.split(": ")[1] for line in problems_of(path)] == ["rig.sed", "prefilter.median", "fits.bearing.focus"]
    path = write_quick(tmp_path, ("6000", "7000"), ("piezo_pair", "piezo"), ("to_s: 0.4", "to_s: 0.1"))
    keys = [line.split(": ")[1] for line in problems_of(path)]
    assert keys == ["rig.operating_points[0].speed_rpm", "fits.piezos.structure", "figures.bearing.to_s"]


def test_faults_of_form_do_not_hide_those_of_meaning(tmp_path):
    path = write_quick(tmp_path, ("seed: 3", "sede: 3"), ("rotor_bearing", "rotor_baering"), ("on: cyclic", "on: p9"))
    keys = [line.split(": ")[1] for line in problems_of(path)]
    assert keys == ["rig.sede", "fits.bearing.structure", "crossval.bearing.on"]
    # a block that cannot be read would make what refers to it look wrong as well
    path = write_quick(tmp_path, ("fits:", "fit:"))
    assert [line.split(": ")[1] for line in problems_of(path)] == ["fit"]
    path = write_quick(tmp_path, ("recordings: 2", "recordings: two"), ("to_s: 0.4", "to_s: 0.1"))
    assert [line.split(": ")[1] for line in problems_of(path)] == ["rig.prbs.recordings", "figures.bearing.to_s"]


def test_missing_keys_and_sections(tmp_path):
    path = write_quick(tmp_path, text="format: 1\n")
    assert problems_of(path) == ["1:1: name: is missing; add it"]
    path = write_quick(tmp_path, text="format: 1\nname: x\n")
    assert "no recordings" in problems_of(path)[0]
    path = write_quick(tmp_path, text="- 1\n")
    assert "expected keys" in problems_of(path)[0]
    path = write_quick(tmp_path, text="")
    assert "found nothing" in problems_of(path)[0]


def test_faults_of_yaml_have_positions(tmp_path):
    (line,) = problems_of(write_quick(tmp_path, ("name: quick", "name: quick\nname: twice")))
    assert line.startswith("3:1: ")
    assert "duplicate key" in line
    (line,) = problems_of(write_quick(tmp_path, ("seed: 3", "seed: [3")))
    assert int(line.split(":")[0]) >= 4
    (line,) = problems_of(write_quick(tmp_path, ("  seed", "\tseed")))
    assert line.startswith("4:1: ")


def test_each_mistake_is_one_line(tmp_path):
    """A point twice is not seven recordings twice; an entry that is wrong is not also a list too short."""
    head, point = "format: 1\nname: twice\nrig:\n", "{pressure_bar: 5, speed_rpm: 0}"
    path = write_quick(tmp_path, text=f"{head}  operating_points: [{point}, {point}]\n  prbs: {{recordings: 6}}\n")
    (line,) = problems_of(path)
    assert "rig.operating_points[1]: the same operating point as operating_points[0]; delete one" in line
    stacks = "  actuators: {kind: stacks}\n  stack_staircase: {stacks: [5]}\n"
    path.write_text(f"{head}  operating_points: [{point}]\n{stacks}")
    (line,) = problems_of(path)
    assert "rig.stack_staircase.stacks[0]: must be at most 4, found 5" in line


def test_a_long_list_of_what_there_is_ends_early(tmp_path):
    points = ", ".join(f"{{pressure_bar: {p}, speed_rpm: 0}}" for p in (3, 4, 5, 6, 7))
    path = tmp_path / "experiment.yaml"
    path.write_text(
        f"format: 1\nname: many\nrig:\n  operating_points: [{points}]\n  prbs: {{recordings: 7}}\n"
        "fits: {bearing: {structure: rotor_bearing}}\ncrossval: {bearing: {on: other}}\n"
    )
    (line,) = problems_of(path)
    assert (
        "no recording matches 'other'; did you mean 'others'? choose from cyclic, others, point, p3_n0_still1" in line
    )
    assert line.endswith(" and 35 more")


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("run1.csv", "run9.csv", "file: run9", ["import.recordings[0].file", "no file", "run9.csv"]),
        ("run1.csv", "run1.txt", "file: run1.txt", ["no file", "run1.txt"]),
        ("data_folder: data", "data_folder: dat", "data_folder: dat", ["no folder"]),
        ("name: run2", "name: run1", "name: run1\n      file: run2", ["a second recording named 'run1'"]),
        ("      time: time\n", "", "name: run1", ["neither sample_time_s nor time"]),
        ("spring.py:structure", "other.py:structure", 'structure: "oth', ["no file"]),
        ("spring.py:structure", "spring.py:other", 'structure: "spr', ["no name 'other'"]),
        ("on: cyclic", "on: [cyclic, run1]", "on: [cyc", ["stands alone"]),
    ],
)
def test_meaning_of_an_import_is_checked(tmp_path, old, new, place, words):
    path = write_spring(tmp_path, (old, new))
    text = SPRING.replace(old, new)
    line = problems_of(path)[0]
    where = place if place in text else new
    assert line.startswith(place_of(text, where).split(":")[0] + ":")
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("import gbid", "import nosuchmodule", "import failed"),
        ('"C": [[1, 0]]', '"C": [[1, 0, 0]]', "C has shape (1, 3), expected (1, 2)"),
        ("structure = ", "other = ", "no name 'structure'"),
        ("import gbid", "import gbid, sys; sys.exit(0)", "import failed: SystemExit: 0"),
    ],
)
def test_broken_structure_files_are_named(tmp_path, old, new, words):
    path = write_spring(tmp_path)
    (tmp_path / "spring.py").write_text(SPRING_STRUCTURE.replace(old, new))
    (line,) = problems_of(path)
    assert line.startswith(place_of(SPRING, 'structure: "spring') + ": fits.spring.structure: ")
    assert words in line


def test_shipped_experiments_load():
    assert load_experiment(EXPERIMENTS / "quickstart.yaml").spec.title
    for name in ("twin_mode_rig", "rotary_arm"):
        path = EXPERIMENTS / f"{name}.yaml"
        data = path.parent / "../../shared/data" / f"{name}.npz"
        if data.is_file():
            assert load_experiment(path).spec.name == name
        else:  # without the data that is all that is wrong
            assert all("import" in line for line in problems_of(path))


ODD = [None, -1, "a", [[]], {"a": {}}]
ODD_FORMS = [True, 1.5, "6", [], [None], [{}], [1, "a"], {}, {"a": [None]}, {0.0: None, "k": 6}, {None: 1}, {True: 2}]


def branches(kind) -> list:
    """Forms of a type: those of a union, at any depth."""
    while get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, UnionType):
        return [form for each in get_args(kind) for form in branches(each) if form is not NoneType]
    return [kind]


def places(kind, value=lambda odd: odd, above=()):
    """Each place of a type: its branches, and a function from an odd value to the YAML with this value there."""
    yield branches(kind), value
    for form in branches(kind):
        origin, inside = get_origin(form), get_args(form)
        if isinstance(form, type) and issubclass(form, BaseModel) and form not in above:
            goal = {"goal": form.__name__.removesuffix("Section")} if "goal" in form.model_fields else {}
            for name, field in form.model_fields.items():
                key = field.alias or name
                yield from places(field.annotation, lambda odd, k=key, g=goal: value({**g, k: odd}), (*above, form))
        elif isinstance(origin, type) and issubclass(origin, Mapping):
            yield from places(inside[1], lambda odd: value({"k": odd}), above)
        elif isinstance(origin, type) and issubclass(origin, Sequence):
            for i, each in enumerate(inside):
                if each is not ...:
                    yield from places(each, lambda odd, n=i + 1: value([odd] * n), above)


def test_every_odd_value_is_a_fault_at_a_place_of_the_file():
    """All places of the schema; where a union is, its branches by name, too, which pydantic adds to its locations."""
    unions = 0
    for forms, yaml_with in places(ExperimentFile):
        union = len(forms) > 1
        unions += union
        named = [{name: {name: 1}} for form in forms if (name := getattr(form, "__name__", "word"))]
        for odd in [*ODD, *(ODD_FORMS + named if union else [])]:
            data = yaml_with(odd)
            _, faults = _parse(data)
            for location, text in faults.items():
                node = data
                for key in location[:-1] if text == "is missing; add it" else location:
                    node = node[key]
                assert "\n" not in text
            _without(data, faults)
    assert unions > 25


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seed: 3", f"seed: 0x{4000 * 'f'}", "a whole number beyond 1.8e308"),
        ("name: quick", "name: quick\n1.5: 2", "keys should be strings"),
        ("name: quick", 'name: quick\nresults: "a\\0b"', "results: 'a\\x00b': a path cannot contain a NUL character"),
        ("name: quick", f"name: quick\nresults: {300 * 'x'}", "bytes, its longest part 300"),
        ("seed: 3", f"seed: 3\n  model: {300 * 'x'}.yaml", "rig.model: xxx"),
    ],
)
def test_numbers_and_paths_without_measure_are_named(tmp_path, old, new, words):
    with pytest.raises(UsageError, match=re.escape(words)) as caught:
        load_experiment(write_quick(tmp_path, (old, new)))
    assert len(str(caught.value)) < 400


def test_a_key_with_the_name_of_a_branch_is_found_where_it_stands():
    _, faults = _parse({"controller": {"main": {"goals": [{"goal": "MaxDamping", "MaxDamping": {"MaxDamping": 1}}]}}})
    assert ("controller", "main", "goals", 0, "MaxDamping") in faults
    assert ("controller", "main", "goals", 0, "MaxDamping", "MaxDamping") not in faults


def test_factors_of_the_poles_go_to_the_stacks_of_their_axis():
    experiment = load_experiment(EXPERIMENTS / "theisen2016.yaml")
    stacks = rig_run(experiment, experiment.recordings["p3_n0_prbs1"]).machine.actuator.stacks
    for name, factors in (("slow_pole", (2.36, 0.93)), ("fast_pole", (0.4, 1.173))):
        results = [getattr(a, name) / getattr(b, name) for a, b in zip(stacks, PiezoStacks().stacks, strict=True)]
        assert results == pytest.approx([factors[1], factors[0], factors[1], factors[0]])  # 1 and 3 move y, 2 and 4 x


def test_a_value_with_an_unknown_tag_is_text(tmp_path):
    path = write_quick(tmp_path, text="format: 1\nname: tagged\nimport: {data_folder: ., recordings: !! }\n")
    assert "import.recordings: expected a list, found ''" in problems_of(path)[0]


def test_each_key_is_described_once():
    """Editors and the page of all keys show these lines."""
    schema = experiment_json_schema()
    sections = {"": schema, **{section["title"]: section for section in schema["$defs"].values()}}
    keys = {(name, key): value for name, each in sections.items() for key, value in each["properties"].items()}
    assert [key for key, value in keys.items() if not value.get("description")] == []
    assert [key for key, value in keys.items() if value["description"].startswith("See ")] == []
    path = Path(gbid.experiment.__file__).with_name("keys.toml")
    lines = tomllib.loads(path.read_text(encoding="utf-8"))
    anywhere = {key for _, key in keys}
    assert [key for key in lines.pop("any") if key not in anywhere] == []
    assert [(name, key) for name, each in lines.items() for key in each if (name, key) not in keys] == []
