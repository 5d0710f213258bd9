# SPDX-License-Identifier: Apache-2.0
"""Law files of the package: those that the paper, and pages, compare the law with.

Each is a law as a user's own would be (doc/tutorial_law.md), found by its name: `law: paper`.
"""
