# SPDX-License-Identifier: Apache-2.0
"""What a second encoder in each joint is worth: feedback of links, of motors, or of both.

    python -m benchmark two-encoders [margins] [--arms NAME...]
    python -m benchmark two-encoders loops [--arms NAME...]

The arms are those of `soft_arms`.

`margins`: their linear loop along the motion, without and with the load.  The law is this law
without its load observer, tau = -C_y y - C_v v.  By where y and v are measured (q: links, theta:
motors; crossed: y = theta + w / (s + w) (q - theta), the tool at rest and the motor above w), a
cell has the largest factor on stiffness and damping of the preset up to which every smaller one
leaves the modulus margin 0.5 above 5 Hz, and beside it that on the stiffness if damping over
stiffness may be chosen, too, from RATIOS times that of the preset.

The margin is the least singular value of I + C G, cut at the torques.  From a factor on that is
stable, a loop stays stable while none of them is 0 at any frequency.  The integral, which is slow
and which no small factor bears, is left out.

`loops`: the first true arm of `soft-arms` with this law at factors of `margins`, with velocities
of links, and of motors, which it takes for those of links; and the same with play.  A row has
the errors of `soft-arms` and how much torques shake.  Nothing guards it or softens its gains.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from benchmark import random_arms, soft_arms
from benchmark.elastic import FREE
from benchmark.harness import print_table
from benchmark.load_observer import SECONDS
from benchmark.load_observer import largest as largest_errors
from benchmark.random_arms import Described
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import (
    SLOWEST,
    Complex,
    Feedback,
    Floats,
    Timing,
    arm_response,
    law_responses,
)
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.factory.controller import begin, controller_of
from sim_plant.plant import plant_of

RUNS = {  # factors with velocities of links, and of motors
    'ur5e': ((1.0,), (1.0, 2.0)),
    'ur5e_soft': ((0.2,), (1.0, 2.0)),
    'panda_no_loop': ((0.38,), (0.98,)),
}
TRUTH = 1
ARMS = 'ur5e', 'ur5e_soft', 'panda', 'panda_no_loop', 'fr3'
LINKS, MOTORS, CROSSED = 'q', 'theta', 'crossed'
PLACES = ((LINKS, LINKS), (MOTORS, MOTORS), (LINKS, MOTORS), (CROSSED, MOTORS))
CROSSING = 10.0  # w, rad/s
FACTORS = np.geomspace(0.02, 8.0, 61)  # 10 % apart
RATIOS = (0.6, 1.0, 1.6)
LOWEST, FASTEST, COUNT = 0.05, 0.48, 240  # Hz, of the sample rate, of frequencies
NOTHING = 1e-3  # a singular value that passes for 0


class Responses(NamedTuple):
    """What an arm does, (k, f, n, n) [rad/(N m)], at s = i omega (f,)."""

    s: Complex
    of: dict[str, Complex]  # by what is measured


def responses(arm: Described) -> Responses:
    """Return positions of links and motors, and both crossed, by torques."""
    frequencies = np.geomspace(LOWEST, FASTEST / arm.timing.period, COUNT)
    s: Complex = np.asarray(2j * np.pi * frequencies, complex)
    q, theta = (
        arm_response(arm.links, arm.joints._replace(motor_side=side), arm.timing, s)
        for side in (False, True)
    )
    slow = (CROSSING / (s + CROSSING))[:, None, None]
    return Responses(s, {LINKS: q, MOTORS: theta, CROSSED: theta + slow * (q - theta)})


def velocity(timing: Timing, s: Complex) -> Complex:
    """Return the differenced and filtered velocity of a position (f, 1, 1) [1/s]."""
    T = timing.period
    z = np.exp(T * s)[:, None, None]
    decay = np.exp(-T / timing.velocity_lag)
    return np.asarray((1.0 - decay) * (1.0 - 1.0 / z) / T / (1.0 - decay / z))


def with_ratio(feedback: Feedback, ratio: float) -> Feedback:
    """Return a law with this multiple of the damping, and the same stiffness; no integral."""
    return feedback._replace(
        surface=ratio * feedback.surface,
        integral=0.0 * feedback.integral,
        rate=feedback.rate / ratio,
    )


def loop_gain(
    seen: Responses, timing: Timing, feedback: Feedback, places: tuple[str, str]
) -> Complex:
    """Return C G (k, f, n, n) of a law that measures y and v at these places."""
    of_position, of_velocity = law_responses(feedback, timing.period, seen.s)
    y, v = places
    moved = velocity(timing, seen.s) * seen.of[v]
    return np.asarray(of_position @ seen.of[y] + of_velocity @ moved)


def largest(seen: Responses, gain: Complex) -> float:
    """Return the largest factor on a loop gain up to which it holds; 0: none does."""
    one = np.eye(gain.shape[-1])
    fast = np.abs(seen.s) > 2.0 * np.pi * SLOWEST
    held = 0.0
    for factor in FACTORS:
        least: Floats = np.linalg.svd(one + factor * gain, compute_uv=False)[..., -1]
        if least.min() < NOTHING or least[:, fast].min() < MARGIN:
            break
        held = float(factor)
    return held


def row(name: str) -> list[str]:
    """Return the factors of an arm."""
    loop = soft_arms.loop_with(soft_arms.ARMS[name], {})
    arm = random_arms.describe(loop.controller, loop.plant, soft_arms.POSTURES)
    feedback = random_arms.own_feedback(loop.controller, arm.M0)
    seen = responses(arm)
    cells = []
    for places in PLACES:
        factors = {
            ratio: largest(
                seen, loop_gain(seen, arm.timing, with_ratio(feedback, ratio), places)
            )
            for ratio in RATIOS
        }
        best = max(factors, key=lambda ratio: factors[ratio])
        cells.append(f'{factors[1.0]:.2g}; {factors[best]:.2g} ({best:g})')
    return [soft_arms.ARMS[name].label, *cells]


def run(loop: LoopConfig, *, of_motors: bool) -> tuple[list[float], float]:
    """Return the errors [mrad] of a loop, infinite where it leaves FREE, and its shaking."""
    controller, arm = controller_of(loop.controller), plant_of(loop.plant)
    n, dt = len(loop.controller.joints), loop.controller.sample_time
    encoder = loop.plant.sensor
    passed = 1.0 - np.exp(-encoder.velocity_pole * dt)

    def motors() -> Floats:
        return np.asarray(
            encoder.resolution * np.rint(arm.motors[0] / encoder.resolution)
        )

    measurement = np.array(arm.measure())
    begin(controller, loop.controller, *measurement.reshape(3, n)[:2])
    before, speed = motors(), np.zeros(n)
    errors = np.zeros((round(SECONDS / dt), n))
    torques = np.zeros_like(errors)
    for k, error in enumerate(errors):
        measurement[:] = arm.measure()
        if of_motors:
            now = motors()
            speed += passed * ((now - before) / dt - speed)
            before = now
            measurement[n : 2 * n] = speed
        torques[k] = controller.update(k * dt, dt, measurement)
        error[:] = controller.sample.xi1
        controller.perceive(dt)
        arm.step(torques[k])
        if np.abs(error).max() > FREE:
            errors[k:] = np.inf
            break
    t = dt * np.arange(len(errors))
    of_limit = torques[t >= random_arms.BEGIN] / controller.settings.torque.limit
    return largest_errors(t, errors), random_arms.shaken(of_limit, dt)


def loops(name: str) -> Iterator[list[str]]:
    """Compute the rows of an arm in simulation."""
    arm = soft_arms.ARMS[name]
    true = {**arm.plant, **soft_arms.drawn(arm, TRUTH)}
    plays = 0.0, soft_arms.PLAY
    for play, of_motors in itertools.product(plays, (False, True)):
        for factor in RUNS[name][of_motors]:
            gears = [play] * len(random_arms.ROBOTS[arm.robot].stiffness)
            own = arm._replace(plant={**true, 'joint.backlash': gears})
            gains = {**arm.gains, 'feedback.stiffness': factor}
            loop = soft_arms.loop_with(own, gains, truth=TRUTH)
            errors, shaking = run(loop, of_motors=of_motors)
            yield [
                arm.label,
                f'{1e3 * play:g} mrad',
                MOTORS if of_motors else LINKS,
                f'{factor:g}',
                ', '.join(f'{each:.2f}' for each in errors),
                f'{100.0 * shaking:.1f} %',
            ]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    tables = 'margins', 'loops'
    parser.add_argument('table', nargs='?', choices=tables, default='margins')
    parser.add_argument('--arms', nargs='+', choices=ARMS, default=list(ARMS))


def main(given: argparse.Namespace) -> None:
    """Print the table that was asked for."""
    if given.table == 'loops':
        heads = 'arm', 'play', 'v of', 'factor', 'in motion, pick-up, later', 'shakes'
        chosen = (loops(name) for name in given.arms if name in RUNS)
        print_table(heads, itertools.chain.from_iterable(chosen))
        return
    names = (f'y of {y}, v of {v}' for y, v in PLACES)
    print_table(('arm', *names), map(row, given.arms))
