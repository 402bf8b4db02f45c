"""A new controller structure is one class in one file: Python, YAML, tuning and controller files find it there."""

from pathlib import Path

import pytest
from experiment_files import QUICK

import gbid
from gbid.control.controllers import built_in
from gbid.control.controllers.built_in import built_in_structures
from gbid.core.errors import UsageError
from gbid.experiment.load import load_experiment

LEAD = '''
@dataclass(frozen=True)
class LeadStructure(PerAxis):
    """Lead filter: static gain, and a zero below the pole of the low-pass."""

    longest_ms: float = 1.0
    name: str = "lead"

    def _axis_gains(self):
        return (AxisGain("kappa", 0.0, 0.0, 3.0, "m/m"), AxisGain("zero", 0.0, 0.0, self.longest_ms, "ms"))

    def _filter(self, gain, lowpass):
        A, B, C, _ = lowpass
        T = 1e-3 * gain["zero"]
        return A, B, gain["kappa"] * (C + T * (C @ A)), gain["kappa"] * T * (C @ B)
'''
CONTROLLER = """\
controller:
  forward: {model: theisen2016, structure: lead, operating_points: [{pressure_bar: 6, speed_rpm: 0}]}
"""


@pytest.fixture
def lead():
    exec(LEAD, vars(built_in))  # as if the text stood at the end of the file
    built_in_structures.cache_clear()
    yield
    del built_in.LeadStructure
    built_in_structures.cache_clear()


def test_it_is_found_by_its_name(lead) -> None:
    assert {"P", "PD", "biquad", "lead"} < set(built_in_structures())
    names = [gain.name for gain in gbid.controller_structure("lead").parameters]
    assert names == ["kappa_x", "kappa_y", "zero_x", "zero_y"]
    with pytest.raises(UsageError, match=r"unknown option speed; choose from .*longest_ms"):
        gbid.controller_structure("lead", speed=1.0)


def test_it_is_tuned_and_stored(lead, tmp_path: Path) -> None:
    model = gbid.load_model("theisen2016")
    result, feedback = (
        gbid.tune(model, controller=name, operating_points=[(6, 0)], peak_sensitivity=2.0, starts=0)
        for name in ("lead", "P")
    )
    assert result.value > feedback.value + 0.001  # P is the lead whose zero is at 0 ms
    path = tmp_path / "lead.yaml"
    gbid.save_controller(path, result.controller, result.gains, sample_time=2e-4)
    design = gbid.load_controller(path)
    assert design.structure.name == "lead"
    assert design.gains == pytest.approx(dict(result.gains))
    loop = gbid.close_loop(model.plant_at(6, 0), design.at())
    assert min(damping for _, damping in loop.modes()) == pytest.approx(result.value, abs=1e-6)


def test_the_yaml_knows_it(lead, tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(QUICK + CONTROLLER, encoding="utf-8")
    assert load_experiment(path).spec.controller["forward"].structure == "lead"
    path.write_text(QUICK + CONTROLLER.replace("structure: lead", "structure: leaf"), encoding="utf-8")
    with pytest.raises(UsageError, match="did you mean 'lead'"):
        load_experiment(path)
