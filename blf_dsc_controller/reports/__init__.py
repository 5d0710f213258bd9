# SPDX-License-Identifier: Apache-2.0
"""What a run was like: figures, and numbers."""
