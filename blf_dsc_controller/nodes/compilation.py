# SPDX-License-Identifier: Apache-2.0
"""Saying that the kernels are being compiled, before a wait that would look like a fault."""

from __future__ import annotations

from blf_dsc_controller.compiled.jit import is_compiled
from blf_dsc_controller.law.controller import respond

CONTROLLER = (respond,)

NOTICE = 'compiling the kernels, once for this version: this takes 10 to 60 s'
"""What to say."""

__all__ = ['CONTROLLER', 'NOTICE', 'is_compiled']
