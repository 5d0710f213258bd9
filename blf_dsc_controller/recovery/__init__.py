# SPDX-License-Identifier: Apache-2.0
"""Clean bags from damaged ones."""
