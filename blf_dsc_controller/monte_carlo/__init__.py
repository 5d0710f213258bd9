# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo studies: random plants, run in parallel and evaluated."""
