# SPDX-License-Identifier: Apache-2.0
"""Laws side by side on arms whose URDF is wrong, tuned by one procedure."""
