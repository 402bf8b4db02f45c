"""Make a folder of results with many fits, to measure what reads it.

``python -m tests.benchmarks.many_results FOLDER --count 1000``

Recordings and fits are copies of four real ones under other names and with the content keys of these names, so that
all verbs take them for made.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gbid.core.hdf5 import changing
from gbid.experiment.campaign import run_campaign
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import writing_keyed
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.experiment.stages.fit import fit_tasks
from gbid.experiment.stages.rig import rig_tasks

REAL = 4
"""Fits that are computed; the others are their copies."""

YAML = """\
format: 1
name: many
rig:
  model: theisen2016
  operating_points: [{{pressure_bar: 5.0, speed_rpm: 6000}}]
  duration_s: {duration_s}
  prbs: {{recordings: {count}, amplitude_m: 4.5e-6, hold_s: 20.0e-3}}
  stationary: {{recordings: 0}}
fits:
  piezos: {{structure: piezo_pair}}
"""


def make_results(folder: Path, count: int, duration_s: float = 1.0) -> Experiment:
    """Return an experiment in a new folder with a number of recordings, each with its fit.

    Parameters
    ----------
    folder : path
        Folder of the experiment file, which must not have one.
    count : int
        Number of recordings.
    duration_s : float
        Duration of each recording [s]; there are 5000 samples a second.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "experiment.yaml"
    path.write_text(YAML.format(count=min(count, REAL), duration_s=duration_s), encoding="utf-8")
    run_campaign(Job(load_experiment(path)))
    path.write_text(YAML.format(count=count, duration_s=duration_s), encoding="utf-8")
    job = Job(load_experiment(path))
    recordings, fits = rig_tasks(job), fit_tasks(job)
    for tasks, attribute in ((recordings, "name"), (fits, "recordings")):
        for number, task in enumerate(tasks[REAL:]):
            with writing_keyed(task.path, task.key) as part:
                shutil.copyfile(tasks[number % REAL].path, part)
                with changing(part) as file:
                    file.attrs[attribute] = task.item.section if tasks is recordings else list(task.recordings)
                    text = file["document"][()].tobytes()
                    for real, copied in zip(tasks[number % REAL].recordings, task.recordings, strict=True):
                        text = text.replace(f'"{real}"'.encode(), f'"{copied}"'.encode())
                    del file["document"]
                    file["document"] = np.frombuffer(text, np.uint8)
    return job.experiment


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the folder and print the path of its experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=1000)
    options = parser.parse_args(arguments)
    print(make_results(options.folder, options.count).file.path)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
