# SPDX-License-Identifier: Apache-2.0
"""The simulated arm: dynamics, loads, sensors and drives, as kernels without ROS."""
