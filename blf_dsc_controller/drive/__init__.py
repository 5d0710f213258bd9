# SPDX-License-Identifier: Apache-2.0
"""The guarded law on a robot's own interface, in one process and without ROS."""
