# SPDX-License-Identifier: Apache-2.0
"""MCAP bags: write, read, recover; without a ROS installation."""
