# SPDX-License-Identifier: Apache-2.0
"""The live page: an arm, its reference and its controller in the browser."""
