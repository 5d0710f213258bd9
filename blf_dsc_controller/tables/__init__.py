# SPDX-License-Identifier: Apache-2.0
"""Files of tables: which columns are the time, positions and torques, and their values."""
