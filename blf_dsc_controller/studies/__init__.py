# SPDX-License-Identifier: Apache-2.0
"""Studies: the paper's claims, laws side by side, and random plants by the thousand."""
