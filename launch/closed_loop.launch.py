# SPDX-License-Identifier: Apache-2.0
"""Start the simulated arm, the controller and, with `bag`, the recorder.

For instance: ros2 launch blf_dsc_controller closed_loop.launch.py mode:=lockstep bag:=run1
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.params_file import load, locate
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.share import share_folder
from sim_plant.arms import urdf_of

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
                default_value='',
                choices=['', 'realtime', 'lockstep'],
                description='step on the wall clock, or wait for each torque; empty: as configured',
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
            DeclareLaunchArgument(
                'markers',
                default_value='false',
                choices=['false', 'true'],
                description='publish reference, bound and torques for RViz and Foxglove',
            ),
            DeclareLaunchArgument(
                'rviz',
                default_value='false',
                choices=['false', 'true'],
                description='open RViz on the arm, with its markers',
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[Node]:
    """Make the nodes, once the arguments are known."""
    config, mode, namespace, bag, markers, rviz = (
        LaunchConfiguration(name).perform(context)
        for name in ('config', 'mode', 'namespace', 'bag', 'markers', 'rviz')
    )
    common = {'package': PACKAGE, 'namespace': namespace, 'output': 'screen'}
    parameters = [str(locate(config))]
    if bag:  # The first sample is to be in it too: nobody starts before the recorder listens.
        parameters.append({'wait_for_subscribers': 1})
    of_plant = [*parameters, {'mode': mode}] if mode else parameters
    loop = [
        Node(executable='sim_plant', parameters=of_plant, on_exit=Shutdown(), **common),
        Node(executable='blf_dsc_controller', parameters=parameters, **common),
    ]
    if bag:
        of_recorder = [parameters[0], {'output': bag}]
        loop.append(Node(executable='bag_recorder', parameters=of_recorder, **common))
    if 'true' in (markers, rviz):
        loop.append(Node(executable='arm_markers', parameters=parameters[:1], **common))
    if rviz == 'true':
        loop += view(namespace, str(locate(config)))
    return loop


def view(namespace: str, config: str) -> list[Node]:
    """RViz, and what turns the arm's states into frames for it; both are packages of their own."""
    plant = load(config, PLANT, PlantConfig)
    robot = plant.robot
    frame = robot.chain(plant.joints).base if robot.urdf else 'base_link'
    return [
        Node(
            package='robot_state_publisher',
            executable='robot_state_publisher',
            namespace=namespace,
            parameters=[{'robot_description': urdf_of(plant)}],
        ),
        Node(
            package='rviz2',
            executable='rviz2',
            namespace=namespace,
            arguments=['-d', str(share_folder() / 'config' / 'arm.rviz'), '-f', frame],
        ),
    ]
