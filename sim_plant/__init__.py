# SPDX-License-Identifier: Apache-2.0
"""The arm to be controlled: its physics, its sensors and actuators, and its ROS 2 node."""
