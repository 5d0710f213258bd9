# SPDX-License-Identifier: Apache-2.0
"""Configuration: frozen dataclasses of parameters, and the parameter files that set them."""
