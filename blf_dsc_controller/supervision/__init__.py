# SPDX-License-Identifier: Apache-2.0
"""Supervision of the law: checks, stops, the safe torque. No ROS."""
