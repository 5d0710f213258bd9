# SPDX-License-Identifier: Apache-2.0
"""Start the controller, its watchdog, the simulated arm, and the recorder.

For instance: ros2 launch blf_dsc_controller closed_loop.launch.py config:=noisy
bag:=run1 and for the driver of an arm: ros2 launch blf_dsc_controller
closed_loop.launch.py driver:=fr3
"""

from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from blf_dsc_controller.configuration.nodes import PLANT, load, locate
from blf_dsc_controller.configuration.plant import PlantConfig

PACKAGE = 'blf_dsc_controller'


# Of each driver: its parameter file, joint states and commands.
DRIVERS = {
    # joint_state_broadcaster at update_rate; joint_states is joint_state_publisher's,
    # at 30 Hz
    'fr3': ('fr3', 'franka/joint_states', 'fr3_effort_controller/commands'),
    'ur5e': ('ur5e_driver', 'joint_states', 'forward_effort_controller/commands'),
}
ARGUMENTS = {  # choices and description; the default is empty
    'config': (
        None,
        'parameter file of all nodes, or a preset; empty: of the driver, or recommended',
    ),
    'driver': (
        ['', *DRIVERS],
        'driver of an arm, whose topics are used; empty: the simulated arm',
    ),
    'namespace': (
        None,
        'of all nodes; in a file, the key /**/NODE matches any namespace',
    ),
    'bag': (
        None,
        'folder to record into, which must not exist yet; empty: no recording',
    ),
}


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; `--show-args` lists them."""
    declared = [
        DeclareLaunchArgument(name, default_value='', choices=choices, description=text)
        for name, (choices, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])


def nodes(context: LaunchContext) -> list[Node]:
    """Create the nodes once the arguments are known."""
    config, robot, namespace, bag = (
        LaunchConfiguration(name).perform(context) for name in ARGUMENTS
    )
    own = f'{PACKAGE}/commands'  # as other nodes than the controller write it
    of_driver, states, commands = DRIVERS.get(
        robot, ('recommended', 'joint_states', own)
    )
    remappings = [('joint_states', states), ('~/commands', commands), (own, commands)]
    is_simulated = not robot
    file = str(locate(config or of_driver))
    # The first sample must be recorded too, so the loop starts after the recorder
    # subscribes.
    of_loop = {'wait_for_subscribers': 1} if bag else {}
    of_controller = of_loop | {'safety.expect_watchdog': True}

    def node(
        executable: str,
        given: dict[str, Any],
        *,
        required: bool = True,
        respawned: bool = False,
    ) -> Node:
        return Node(
            package=PACKAGE,
            executable=executable,
            # With a name, `given` is for this node: a section /**/NODE of the file
            # would override parameters for any node.
            name=executable,
            namespace=namespace,
            parameters=[file, given] if given else [file],
            remappings=remappings,
            output='screen',
            on_exit=Shutdown(reason=f'{executable} has ended') if required else None,
            respawn=respawned,
            respawn_delay=1.0,
        )

    started = []
    if bag:
        mode = load(file, f'{namespace}/{PLANT}', PlantConfig).mode
        clock = 'plant' if is_simulated and mode == 'lockstep' else 'wall'
        recorded = {'output': bag, 'clock': clock}
        started.append(node('bag_recorder', recorded, required=is_simulated))
    # A new one reads the journal of the controller that is still there.
    started.append(node('torque_watchdog', {}, required=False, respawned=True))
    # On an arm, the watchdog outlives a controller that crashes, and both outlive the
    # recorder.
    started.append(node('blf_dsc_controller', of_controller, required=is_simulated))
    if is_simulated:
        started.append(node('sim_plant', of_loop))
    return started
