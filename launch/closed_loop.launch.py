# SPDX-License-Identifier: Apache-2.0
"""Start the simulated arm, the controller and, if a bag is asked for, the recorder.

For instance: ros2 launch blf_dsc_controller closed_loop.launch.py mode:=lockstep bag:=/tmp/run1
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from blf_dsc_controller.configuration.params_file import locate

PACKAGE = 'blf_dsc_controller'


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; `--show-args` lists them."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'config',
                default_value='recommended',
                description='parameter file for all nodes, or the name of a preset',
            ),
            DeclareLaunchArgument(
                'mode',
                default_value='realtime',
                choices=['realtime', 'lockstep'],
                description='whether the plant steps on the wall clock or waits for each torque',
            ),
            DeclareLaunchArgument(
                'namespace',
                default_value='',
                description='namespace of all nodes; a parameter file speaks to a node in any '
                'namespace under the key /**/NODE',
            ),
            DeclareLaunchArgument(
                'bag',
                default_value='',
                description='folder to record into, which must not exist; empty: no recording',
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[Node]:
    """Make the nodes, once the arguments are known."""
    config, mode, namespace, bag = (
        LaunchConfiguration(name).perform(context)
        for name in ('config', 'mode', 'namespace', 'bag')
    )
    common = {'package': PACKAGE, 'namespace': namespace, 'output': 'screen'}
    file = str(locate(config))
    # A bag is to have the first sample too: nobody starts before the recorder listens.
    observers = {'wait_for_subscribers': 1 if bag else 0}
    loop = [
        Node(
            executable='sim_plant',
            parameters=[file, observers, {'mode': mode}],
            on_exit=Shutdown(),
            **common,
        ),
        Node(executable='blf_dsc_controller', parameters=[file, observers], **common),
    ]
    if bag:
        loop.append(Node(executable='bag_recorder', parameters=[file, {'output': bag}], **common))
    return loop
