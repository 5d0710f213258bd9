# SPDX-License-Identifier: Apache-2.0
"""Messages and MCAP bags, in and out, without a ROS installation."""
