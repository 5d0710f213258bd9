# SPDX-License-Identifier: Apache-2.0
"""The guarded law as an object, without ROS: what the node and other loops run."""
