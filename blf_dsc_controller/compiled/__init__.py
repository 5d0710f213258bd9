# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels: jit with its cache, views on flat vectors."""

COMPILATION_NOTICE = 'compiling the kernels, once for this version: this takes 10 to 60 s'
"""To be printed before a wait that would look like a fault."""
