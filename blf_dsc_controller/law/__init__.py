# SPDX-License-Identifier: Apache-2.0
"""The control law and its learning: compiled kernels without ROS, files or a clock."""
