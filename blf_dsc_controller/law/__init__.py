# SPDX-License-Identifier: Apache-2.0
"""Control laws and their learning: compiled kernels, independent of ROS, files and clocks."""
