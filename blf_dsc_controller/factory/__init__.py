# SPDX-License-Identifier: Apache-2.0
"""The law of a configuration: what it learns, its settings, and its controller."""
