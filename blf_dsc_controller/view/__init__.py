# SPDX-License-Identifier: Apache-2.0
"""The page in a browser that shows an arm and its controller, live or from a bag."""
