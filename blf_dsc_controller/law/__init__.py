# SPDX-License-Identifier: Apache-2.0
"""Control laws, their learning, and the controller: compiled kernels without ROS."""
