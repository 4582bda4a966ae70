"""Checks of the kernels on aarch64, emulated by QEMU; run by ``make test-arm``, not by ``make test``."""
