# SPDX-License-Identifier: Apache-2.0
"""The control law and its learning: pure numbers, no ROS, no files, no clock."""
