# SPDX-License-Identifier: Apache-2.0
"""A small study for tests: runs of 0.3 s with all kinds of variations."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.studies.monte_carlo import load_study
from blf_dsc_controller.studies.runs import run_chunk

RUNS = 24

# A window of 0.1 s is hardly excited, but it latches: learning within 0.3 s.
LOOP = """\
sim_plant:
  ros__parameters:
    duration: 0.3
    events: {begin: [0.0, 0.2], duration: [0.1, 0.0]}
blf_dsc_controller:
  ros__parameters:
    approach: {enabled: false}
    learning: {window: 0.1, settling_time: 0.05, excitation_threshold: 1.0e-12}
"""

STUDY = """\
monte_carlo:
  ros__parameters:
    runs: 24
    seed: 7
    settled_after: 0.2
    vary:
      arm.m2: uniform(0.3, 0.7)
      disturbance.constant: uniform(-0.2, 0.2)
      sensor.position_noise: loguniform(1.0e-6, 2.0e-5)
      sensor.velocity: choice(measured, differenced)
      actuator.delay: integers(0, 3)
      initial.error: uniform(-0.9, 0.9)
      initial.velocity_error: uniform(-0.02, 0.02)
      events.begin: ["uniform(0.05, 0.1)", "choice(0.2)"]
      events.payload: uniform(0.0, 0.2)
      events.torque: ["uniform(-0.5, 0.5)", "choice(0.0)", "uniform(-0.5, 0.5)", "choice(0.0)"]
"""


def write(folder, text=LOOP + STUDY):
    """Write the file of a study and return its path."""
    path = folder / 'study.yaml'
    path.write_text(text)
    return path


def study(folder, text=LOOP + STUDY, **overrides):
    """Return the study of a file with this text."""
    return load_study(write(folder, text), overrides)


def whole(a_study):
    """Return the results of all runs, computed at once in this process."""
    return run_chunk(a_study, 0, a_study.settings.runs)


def same(results, other):
    """Return True if two results are the same, bit for bit; fail otherwise."""
    assert list(results) == list(other)
    for name, values in results.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)
    return True
