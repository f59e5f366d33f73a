import ctypes
import sys

import skinware
from skinware.sensor_types import PRESSURE

N = 16
fingertip = skinware.Structure(
    types=[PRESSURE.measured(unit="counts", maximum=65535)],
    buses=["usb"],
    patch_name=["fingertip"],
    patch_bus=[0],
    module_patch=[0],
    module_kind=["fingertip"],
    sensor_uid=range(N),
    sensor_type=[PRESSURE.id] * N,
    sensor_module=[0] * N,
    dtype="u2",
)
library = ctypes.CDLL(sys.argv[1])  # cc -shared -fPIC -O2 fingers.c -o libfingers.so
library.acquire.restype = ctypes.c_int64
library.acquire.argtypes = [ctypes.c_void_p, ctypes.c_size_t]

with skinware.DriverWriter("fingers", fingertip) as writer:
    while True:
        frame = writer.begin()
        acquired_ns = library.acquire(frame["values"].ctypes.data, N)
        if acquired_ns < 0:
            break
        frame["status"][:] = 0
        frame["module_time_ns"][:] = acquired_ns
        frame["patch_state"][:] = skinware.PatchState.LIVE
        frame["bus_state"][:] = skinware.BusState.LIVE
        writer.commit(acquired_ns)
