# SPDX-License-Identifier: Apache-2.0
"""Supervision of the law: checks, stops and the safe torque, without ROS."""
