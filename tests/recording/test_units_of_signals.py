"""A name says nothing of a unit: another rig's u, v, f, p and r are never metres, volts or newtons in silence."""

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure
from rig_point import actuator, rotor_bearing
from scipy.io import loadmat

import gbid
from gbid import load, save
from gbid.core.errors import UsageError
from gbid.core.units import SIGNALS
from gbid.prefilter import prefilter
from gbid.prefilter.filtering import PrefilterFile, correction_rows, correction_table
from gbid.recording import Recording, import_recording, load_recording, save_recording
from gbid.report.measured_pictures import plot_response
from gbid.rig import Hammer, Machine, Prbs, record

N, H = 600, 0.01
NAMES = ("r", "u", "p", "phi", "force", "f", "v", "y_p", "r_p")


def drive(units=None, channels=1):
    """Recording of a motor: voltage u, speed p."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-5.0, 5.0], (N // 10, channels)), 10, axis=0)
    p = np.zeros((N, channels))
    for k in range(N - 1):
        p[k + 1] = 0.9 * p[k] + 0.3 * u[k]
    return Recording({"u": u, "p": p + 0.01 * rng.standard_normal(p.shape)}, H, name="motor", units=units or {})


def first_order():
    q = [gbid.Parameter("a", -5.0, -50.0, -0.1, unit="1/s"), gbid.Parameter("b", 10.0, 0.1, 1000.0)]
    matrices = lambda p: {"A": p["a"], "B": p["b"], "C": 1.0, "D": 0.0}  # noqa: E731
    return gbid.LinearStructure("motor", q, matrices, inputs=("u",), outputs=("p",), intersample="zoh")


@pytest.mark.parametrize("name", NAMES)
def test_a_name_gives_no_unit(name, tmp_path):
    rec = Recording({name: np.ones((N, 2)), "mine": np.ones((N, 1))}, H)
    assert dict(rec.units) == {name: "", "mine": ""}
    save_recording(rec, tmp_path / "a.h5")
    assert dict(load_recording(tmp_path / "a.h5").units) == {name: "", "mine": ""}
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["signals"][name].attrs["long_name"] == name  # nothing is called a disc position that may be none


def test_recordings_of_the_rig_have_its_units():
    machine = Machine(rotor_bearing(5.0, 6000.0), actuator())
    point = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
    for experiment in (Prbs(0.2), Hammer()):
        made = record(machine, experiment, conditions=point, seed=1, name="a")
        assert dict(made.units) == {name: SIGNALS[name].unit for name in made.signals}
        assert made.units["p"] == prefilter(made)[0].units["p"] == made.slice(0, 100).units["p"] == "m"


def test_what_is_shown_has_the_units_of_the_recording(tmp_path):
    for units, shown in (({}, "-"), ({"u": "V", "p": "rad/s"}, "rad/s")):
        rec = drive(units)
        result = gbid.fit(first_order(), rec, trend="offset")
        offset = next(unit for name, unit in result.units.items() if name.startswith("offset_p"))
        assert offset == units.get("p", "")

        validation = gbid.cross_validate(result, rec)
        assert (validation.input_units, validation.output_units) == ((units.get("u", ""),), (units.get("p", ""),))
        axes = Figure().subplots(2)
        plot_response(validation, list(axes))
        labels = [each.get_ylabel() for each in axes]
        assert any(f"[{shown}]" in label for label in labels)
        assert not any("µm" in label for label in labels)

        stored = loadmat(gbid.save_mat(result, tmp_path / f"motor{len(units)}.mat", units=units), squeeze_me=True)
        assert (str(stored["InputUnit"]), str(stored["OutputUnit"])) == tuple(
            units.get(name, "") or "[]" for name in ("u", "p")
        )


def test_the_prefilter_reports_in_the_unit_of_the_position(tmp_path):
    for units, shown in (({"p": "V"}, "V"), ({"p": "m"}, "µm"), ({}, "")):
        _, report = prefilter(drive(units, channels=2))
        save(PrefilterFile(None, (report,)), tmp_path / "a.h5", overwrite=True)
        (loaded,) = load(tmp_path / "a.h5", PrefilterFile).reports
        assert dict(loaded.units) == {"u": "", "p": units.get("p", "")}
        table = correction_table(correction_rows([loaded]))
        assert [column.unit for column in table.columns[2:4]] == [shown, shown]
    mixed = [prefilter(drive({"p": unit}, channels=2))[1] for unit in ("m", "V")]
    assert correction_table(correction_rows(mixed)).columns[2].unit == "m or V"


def test_an_import_of_another_quantity_says_rename(tmp_path):
    path = tmp_path / "a.csv"
    np.savetxt(path, np.ones((20, 1)), header="drive", comments="")
    for name, unit in (("u", "V"), ("v", "m"), ("f", "A"), ("force", "Pa"), ("phi", "V"), ("r_p", "N")):
        entry = {"columns": ["drive"], "unit": unit}
        with pytest.raises(UsageError, match=f"rename the signal, or give stored_unit: {unit}"):
            import_recording(path, {"signals": {name: entry}, "sample_time": H})
        rec = import_recording(path, {"signals": {name: {**entry, "stored_unit": unit}}, "sample_time": H})
        assert rec.units[name] == unit
    with pytest.raises(UsageError, match=r"no unit; give unit .* rename the signal, or give stored_unit: \.\.\."):
        import_recording(path, {"signals": {"u": {"columns": ["drive"]}}, "sample_time": H})
