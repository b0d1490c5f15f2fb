"""An emulated device as a port in memory, with a clock of its own: minutes of its time in milliseconds, always the same."""

from __future__ import annotations

from uarm_rl.emulator.pty import Device
from uarm_rl.real.ports import READ_S


class MemoryPort:
    """A ``Port`` of ``real.link`` and its clock: ``Link(port, "emulator", clock=port.clock)``.

    ``firmware`` may be the camera as well. Time passes while somebody reads, by ``quantum_s`` at once. ``written`` keeps
    the bytes from the host.
    """

    def __init__(self, firmware: Device, *, quantum_s: float = 0.002) -> None:
        self.firmware = firmware
        self._quantum_s = quantum_s
        self.written = bytearray()
        self._now_s = firmware.now_s
        self._received = bytearray()

    def clock(self) -> float:
        """Seconds since the start, in the arm's time."""
        return self._now_s

    @property
    def in_waiting(self) -> int:
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        deadline_s = self._now_s + READ_S
        while not self._received and self._now_s < deadline_s:
            self._now_s += self._quantum_s
            self._received += self.firmware.advance(self._now_s)
            self._check_cable()
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def write(self, data: bytes) -> int:
        self.written += data  # what was tried
        self._check_cable()
        self._received += self.firmware.advance(self._now_s, data)
        return len(data)

    def close(self) -> None:
        """Nothing to give back."""

    def _check_cable(self) -> None:
        if self.firmware.unplugged:
            raise OSError(5, "Input/output error")
