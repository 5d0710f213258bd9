# SPDX-License-Identifier: Apache-2.0
"""A load that is weighed is told to the service of a driver, over DDS, in lock-step."""

from __future__ import annotations

import importlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import interfaces
from geometry_msgs.msg import Inertia, Vector3
from ros_rig import LIMIT, activate, cleanup, configure, deactivate
from std_srvs.srv import Trigger

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.nodes import CONTROLLER as LAW
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from sim_plant.settings import plant_settings

PACKAGES = ('ur_msgs', 'franka_msgs')
SERVICE = '/driver/set_load'
TOLD = {'load.tell_drive': True, 'load.service': SERVICE, 'learning.window': 2.0}
PICKED_UP = 3.0  # s; it is weighed about a second later
FR3 = blf.load_loop('fr3_direct')
EVENT = {
    'events.begin': [PICKED_UP],
    'events.duration': [0.0],
    'events.payload': [2.0],
    'mode': 'lockstep',
}


@pytest.fixture(scope='module')
def services(tmp_path_factory):
    """Provide the drivers' services by their type."""
    missing = [each for each in PACKAGES if importlib.util.find_spec(each) is None]
    if missing and interfaces.why_not():
        pytest.skip(
            f'{missing[0]} is not installed, and not built: {interfaces.why_not()}'
        )
    with pytest.MonkeyPatch.context() as patch:
        for name in missing:
            folder = tmp_path_factory.mktemp(name)
            interfaces.build(Path(__file__).parent / 'definitions' / name, folder)
            patch.syspath_prepend(folder)
        yield {
            'ur': importlib.import_module('ur_msgs.srv').SetPayload,
            'franka': importlib.import_module('franka_msgs.srv').SetLoad,
        }
    for name in [
        each for each in sys.modules if each.startswith(tuple(missing) or '?')
    ]:
        del sys.modules[name]


class Arm:
    """An FR3 whose drives take a load from a service, and its controller."""

    def __init__(self, ros, service, *, accepts=True, **controller):
        self.ros, self.accepts = ros, accepts
        self.requests = []
        ros.tester.create_service(service, SERVICE, self.take)
        given = flatten(FR3.controller) | TOLD | controller
        waiting = {'autostart': False}
        self.plant = ros.add(PlantNode, flatten(FR3.plant) | EVENT | waiting)
        self.law = ros.add(ControllerNode, given)
        # the law looks for the service by the clock, lock-step does not wait for it
        ros.until(lambda: self.law.declaration.client or self.law.declaration.problem)
        assert configure(ros, self.plant)
        assert activate(ros, self.plant)

    def take(self, request, response):
        """Answer as a driver; the drives add the weight from their next step on."""
        self.requests.append(request)
        response.success = self.accepts
        if self.accepts:
            at = getattr(request, 'center_of_gravity', None)
            centre = request.center_of_mass if at is None else (at.x, at.y, at.z)
            robot = replace(
                self.plant.config.robot,
                drive_payload=request.mass,
                drive_payload_centre=tuple(map(float, centre)),
            )
            config = replace(self.plant.config, robot=robot)
            self.plant.plant.change(plant_settings(config))
        else:
            response.error = 'a controller is active'
        return response

    def run_until(self, time):
        self.ros.until(
            lambda: self.law.guard.reference.time > time, limit=LIMIT + 10.0 * time
        )


def test_driver_that_refuses_is_asked_once(services, ros):
    """As that of a Franka does while a controller is active: it is asked at rest."""
    arm = Arm(ros, services['franka'], accepts=False)
    arm.run_until(5.0)
    assert not arm.requests
    arm.law.guard.motions.brake()
    arm.run_until(6.5)
    assert len(arm.requests) == 1
    asked = f'/driver/set_load refused {arm.requests[0].mass:.2f} kg'
    assert arm.law.declaration.problem == f'{asked}: a controller is active'
    assert arm.requests[0].center_of_mass[2] != 0.0
    assert arm.law.guard.supervisor.running


def test_load_is_told_in_steps_that_no_joint_notices_and_left_to_the_drives(
    services, ros
):
    """By a UR's driver, which accepts it in motion.

    After a reset the law knows of no load: nor may its commands take away what the drives add.
    """
    arm = Arm(ros, services['ur'])
    arm.run_until(6.5)
    masses = [request.mass for request in arm.requests]
    assert len(masses) > 10
    assert (np.diff(masses) > 0.0).all()
    assert masses[-1] == pytest.approx(2.0, abs=0.1)
    assert arm.law.declaration.in_force.mass == pytest.approx(masses[-1])
    last = arm.requests[-1]
    ball = 0.4 * last.mass * (0.75 * last.mass / (np.pi * 1000.0)) ** (2.0 / 3.0)
    assert last.ixx == last.iyy == last.izz == pytest.approx(ball, rel=1e-6)
    assert arm.law.guard.samples.ratio.max() < 0.6
    ros.reset(arm.law)
    guard = arm.law.guard
    ros.until(lambda: guard.reference.time < 5.0)
    ros.until(lambda: guard.reference.time > 0.5 or guard.supervisor.text)
    assert guard.supervisor.running, guard.supervisor.text
    # if the commands took away what the drives add, it would be 0.2
    assert guard.samples.ratio.max() < 0.1
    assert deactivate(ros, arm.law)
    ros.until(lambda: guard.is_settled)
    assert cleanup(ros, arm.law)
    assert configure(ros, arm.law)
    problem = arm.law.declaration.problem
    assert problem.startswith(f'a load of {masses[-1]:.3g} kg is still declared')
    assert 'set it back to robot.drive_payload, and restart the node' in problem
    assert activate(ros, arm.law)
    guard = arm.law.guard
    ros.until(
        lambda: (
            guard.reference.time > 0.2
            or guard.supervisor.text
            or guard.starting.waiting_for
        )
    )
    assert guard.supervisor.running, (guard.supervisor.text, guard.starting.waiting_for)


def test_service_that_cannot_be_called_is_named(ros):
    given = flatten(FR3.controller) | TOLD | {'autostart': False}
    ros.tester.create_service(Trigger, SERVICE, lambda *_: None)
    law = ros.add(ControllerNode, given)
    assert configure(ros, law)
    service = law.declaration
    ros.until(lambda: service.look() or service.problem)
    assert re.fullmatch(
        r'/driver/set_load is a std_srvs/srv/Trigger, but only ur_msgs/srv/SetPayload and .* '
        'can be called',
        service.problem,
    )


def test_load_that_another_node_knows_is_carried_at_once(ros, capfd):
    """As a gripper's node says it; the last one is not known yet."""
    sends = ros.tester.create_publisher(Inertia, f'/{LAW}/expected_load', 10)
    journal = ros.listen(topics.JOURNAL, raw=True)
    plant = ros.add(PlantNode, flatten(FR3.plant) | EVENT | {'autostart': False})
    law = ros.add(ControllerNode, flatten(FR3.controller))

    def ask():
        return ros.call(Trigger, f'/{LAW}/expect_last_load', Trigger.Request())

    assert 'not in command' in ask().message
    assert configure(ros, plant)
    assert activate(ros, plant)
    ros.until(lambda: law.guard.reference.time > 1.0)
    assert 'none has been weighed' in ask().message
    sends.publish(Inertia(m=-1.0))
    sends.publish(Inertia(m=1.5, com=Vector3(z=0.05)))
    ros.until(lambda: any(b'"expected load"' in each for each in journal))
    (event,) = (
        event
        for each in journal
        if (event := decode(each)).type is EventType.EXPECTED_LOAD
    )
    assert (event.content['mass'], event.content['centre']) == (1.5, [0.0, 0.0, 0.05])
    assert '~/expected_load: load: got -1.0 kg' in capfd.readouterr().err
    ros.until(lambda: law.guard.reference.time > 2.0)
    assert law.guard.supervisor.running


@pytest.mark.parametrize('kind', ['ur', 'franka'])
@pytest.mark.parametrize('mass', [2.0, 0.0])
def test_load_that_is_put_down_has_no_centre(services, ros, kind, mass):
    """The flange, link 8, is 0.107 m beyond the frame of the last joint, link 7."""
    given = TOLD | {'robot.tip': 'fr3_link7', 'load.frame': 'fr3_link8'}
    requests = []

    def take(request, response):
        requests.append(request)
        return response

    ros.tester.create_service(services[kind], SERVICE, take)
    law = ros.add(ControllerNode, flatten(FR3.controller) | given)
    ros.until(lambda: law.declaration.client)
    law.declaration.declare(TipLoad(mass, (0.01, 0.02, 0.03) if mass else (0.0,) * 3))
    ros.until(lambda: requests)
    (request,) = requests
    at = getattr(request, 'center_of_gravity', None)
    centre = request.center_of_mass if at is None else (at.x, at.y, at.z)
    expected = (0.01, 0.02, 0.03 - 0.107) if mass else (0.0,) * 3
    assert request.mass == mass
    np.testing.assert_allclose(centre, expected, atol=1e-9)
