"""Hammer impacts on the virtual rig, with and without the paper's controller, and a printer of their modes."""

import gbid
from gbid.control import exact_plant, p_controller, ringing_modes, sample_controller
from gbid.rig import Hammer, Impact, Machine, SampledController, Stationary, record

__all__ = ["Machine", "exact_plant", "gbid", "hit", "model", "paper", "ringing_modes", "sampled", "show"]

model = gbid.load_model("theisen2016")
paper = p_controller(1.125, 0.99)
sampled = sample_controller(paper, 2e-4)


def hit(axis, controller=None):
    """Recording of two impacts along an axis at 6 bar and rest, in open loop or under a sampled controller."""
    machine = Machine.from_parameters(model.key_parameters(6.0, 0.0), model.actuators)
    impacts = tuple(Impact.along(axis, 0.1 + 0.3 * i + 7e-5 * i, 12.0) for i in range(2))
    name = f"{axis}, {'closed' if controller else 'open'}"
    options = {"conditions": {"pressure_bar": 6.0, "speed_rpm": 0.0}, "seed": 1, "name": name}
    running = None
    if controller is not None:  # its zero: the mean of a still run just before
        zero = record(machine, Stationary(0.5), **options).signal("p").mean(axis=0)
        running = SampledController(controller.A, controller.B, controller.C, controller.D, 2e-4, offset=zero)
    return record(machine, Hammer(impacts, 0.7), controller=running, **options)


def show(label, modes, std=None):
    """Print frequency and damping factor of each mode, with standard deviations where there are any."""
    numbers = [f"{frequency:8.3f} Hz, {damping:.4f}" for frequency, damping in modes]
    if std is not None:
        numbers = [f"{n} (± {sf:.3f} Hz, {sz:.4f})" for n, sf, sz in zip(numbers, *std, strict=True)]
    print(f"{label:32}", "   ".join(numbers))
