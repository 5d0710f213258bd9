# SPDX-License-Identifier: Apache-2.0
"""The simulated arm: its physics, sensors and actuators, and its ROS 2 node."""
