# SPDX-License-Identifier: Apache-2.0
"""Replay of recorded joint states through the controller, without ROS or arm."""
