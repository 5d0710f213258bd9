# SPDX-License-Identifier: Apache-2.0
"""Writing, reading and recovery of MCAP bags, without a ROS installation."""
