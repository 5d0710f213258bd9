# SPDX-License-Identifier: Apache-2.0
"""Analysis of a run: metrics, figures and the report page."""
