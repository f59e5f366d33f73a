"""Write contacts in the forms of other middlewares, as plain lists and dictionaries; no middleware is needed.

Forces press on the skin, against its normal. They are in N where the values are pressures in Pa at known places;
elsewhere they are ``newtons_per_load`` times the load, or NaN without it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Doubles
from skinware.tactile.contacts import Contact, ContactSet

ICUB_NEWTONS_PER_COUNT = 0.05
"""Force of a taxel and count in the skin manager of the iCub."""


class IcubPart(NamedTuple):
    """The part of a robot that contacts are on: body part, its link and skin part, in the numbers of the iCub."""

    body_part: int
    link: int
    skin_part: int


def icub_contacts(
    contacts: ContactSet, geometry: Geometry, part: IcubPart, *, newtons_per_load: float | None = ICUB_NEWTONS_PER_COUNT
) -> list[list[Any]]:
    """Return contacts as the skin manager of the iCub sends them, each a list of eight.

    ``[[id, body part, link, skin part], centre of pressure, force, moment, geometric centre, normal, taxels,
    pressure]``: vectors of three, in m and N; the moment is 0; pressure is the mean value of the taxels. Unlike there,
    normals are of length 1, and an id lasts as long as its contact. ``geometry`` has the places of the n taxels.

    Raises:
        ConfigurationError: the places are of another number of taxels.
    """
    if len(geometry) != len(contacts.contact_of):
        raise ConfigurationError(f"contacts of {len(contacts.contact_of)} taxels: the places are of {len(geometry)}")
    return [
        [
            [contact.id, *part],
            contact.cop_m.tolist(),
            _force_n(contact, newtons_per_load).tolist(),
            [0.0, 0.0, 0.0],
            geometry.position_m[contact.taxels].mean(axis=0).tolist(),
            contact.normal.tolist(),
            contact.taxels.tolist(),
            contact.load / contact.n,
        ]
        for contact in contacts
    ]


def tactile_msgs_contacts(
    contacts: ContactSet, stamp_ns: int, *, newtons_per_load: float | None = None
) -> list[dict[str, Any]]:
    """Return contacts with the fields of ``tactile_msgs/TactileContact`` of ROS 2.

    The name is the identity; the torque is that of the force about the origin of the frame. ``stamp_ns`` is the time of
    the frame on the clock of ROS, ns.
    """
    seconds, rest_ns = divmod(stamp_ns, NS_PER_S)
    messages = []
    for contact in contacts:
        force_n = _force_n(contact, newtons_per_load)
        messages.append(
            {
                "header": {"stamp": {"sec": seconds, "nanosec": rest_ns}, "frame_id": contact.frame},
                "name": str(contact.id),
                "position": _xyz(contact.cop_m),
                "normal": _xyz(contact.normal),
                "wrench": {"force": _xyz(force_n), "torque": _xyz(np.cross(contact.cop_m, force_n))},
            }
        )
    return messages


def _force_n(contact: Contact, newtons_per_load: float | None) -> Doubles:
    size_n = contact.force_n
    if np.isnan(size_n) and newtons_per_load is not None:
        size_n = newtons_per_load * contact.load
    return -size_n * contact.normal.astype(np.float64)


def _xyz(vector: npt.NDArray[Any]) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))
