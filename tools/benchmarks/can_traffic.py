"""A stand-in for CAN buses: UDP on the loopback, in datagrams that are ``struct can_frame``, sent at a steady rate.

UDP shares receive buffer, time stamps and drop counter with CAN sockets in the kernel. Run as a program it is the
sender: ``can_traffic.py RATE_HZ SECONDS BOARDS PORT...``; it prints what it sent to each port, as JSON.
"""

from __future__ import annotations

import ctypes
import json
import socket
import sys
import time

import numpy as np

TICK_S = 0.001
FIRST_BOARD = 1
_FRAME = np.dtype([("identifier", "<u4"), ("length", "u1"), ("rest", "u1", 3), ("payload", "u1", 8)])
_IOVEC = np.dtype([("base", np.uint64), ("length", np.uint64)])
_MMSGHDR = np.dtype(
    [(name, np.uint64) for name in ("name", "name_length", "iov", "iov_count", "c", "cl", "f", "length")]
)
_sendmmsg = ctypes.CDLL(None, use_errno=True).sendmmsg
_sendmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int]


def burst_frames(boards: int, cycles: int = 16) -> np.ndarray:
    """Frames of whole bursts of ROBOSKIN boards, one board after the other: (cycles * boards * 32,)."""
    frames = np.zeros((cycles, boards, 16, 2), _FRAME)
    cycle, board, triangle, half = np.ogrid[:cycles, :boards, :16, :2]
    frames["identifier"] = 0x400 | (board + FIRST_BOARD) << 4 | triangle
    frames["length"] = 8
    frames["payload"][:] = (cycle[..., None] + 0 * board[..., None] + 0 * triangle[..., None]).astype(np.uint8)
    frames["payload"][..., 0] = np.where(half == 0, 0x40, 0xC0)
    frames["payload"][:, :, :, 1, 6:] = 0
    return frames.reshape(-1)


class Sender:
    """Sends the same frames by one socket, again and again.

    Args:
        sock: connected or bound to what receives.
        frames: what to send.
    """

    def __init__(self, sock: socket.socket, frames: np.ndarray) -> None:
        self._socket = sock
        self._frames = frames
        self._iov = np.zeros(len(frames), _IOVEC)
        self._iov["base"] = frames.ctypes.data + _FRAME.itemsize * np.arange(len(frames))
        self._iov["length"] = _FRAME.itemsize
        self._headers = np.zeros(len(frames), _MMSGHDR)
        self._headers["iov"] = self._iov.ctypes.data + _IOVEC.itemsize * np.arange(len(frames))
        self._headers["iov_count"] = 1
        self._at = 0
        self.sent = 0

    def send(self, count: int) -> None:
        """Send the next ``count`` frames."""
        while count > 0:
            portion = min(count, len(self._frames) - self._at, 512)
            address = self._headers.ctypes.data + _MMSGHDR.itemsize * self._at
            done = _sendmmsg(self._socket.fileno(), address, portion, 0)
            if done < 0:
                return  # nobody receives any more, or the queue of the interface is full
            self.sent += done
            count -= done
            self._at = (self._at + done) % len(self._frames)


def connected(port: int) -> socket.socket:
    """A socket that sends to a UDP port on the loopback."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    return sock


def main() -> None:
    """Entry point."""
    rate_hz, seconds, boards = float(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
    senders = [Sender(connected(int(port)), burst_frames(boards)) for port in sys.argv[4:]]
    begin = time.monotonic()
    due = 0.0
    while (now := time.monotonic() - begin) < seconds:
        for sender in senders:
            sender.send(round(now * rate_hz) - sender.sent)
        due += TICK_S
        time.sleep(max(0.0, due - (time.monotonic() - begin)))
        due = max(due, time.monotonic() - begin - 5 * TICK_S)
    print(json.dumps([sender.sent for sender in senders]))


if __name__ == "__main__":
    main()
