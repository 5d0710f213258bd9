# SPDX-License-Identifier: Apache-2.0
"""Recorded joint states through the controller again, without ROS and without the arm."""
