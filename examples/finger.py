import struct

import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers import Frame, Identifier, Layout, Module, NoOptions, Patch, Values, taxels
from skinware_drivers.can import CanAdapter
from skinware_drivers.virtual import Emulator, EmulatorOptions, on_a_grid


class Finger(CanAdapter[NoOptions]):
    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    patches = (Patch("finger", [Module(taxels(4))]),)
    layout = Layout([Frame("all", [Identifier(0x123)], length=[8], values=Values(0, "<u2", 4))])


class EmulatedFinger(Emulator[EmulatorOptions]):  # only needed to run it without the hardware
    full_scale, rest, swing, period_s = 4095, 200, 3000, 0.01
    numbers = (1,)
    identifiers = frozenset((0x123,))

    def places(self):
        return on_a_grid(4, columns=2)

    def boot(self, device, now_ns):
        self.start(device, now_ns)  # starts to send as soon as it has power

    def frames(self, device, values):
        return [(0x123, struct.pack("<4H", *values))]
