"""The error tree. Every message says what was wrong, where, and what to do about it."""

from __future__ import annotations

from skinware.status import BusReason


class SkinwareError(Exception):
    """Base class of all errors of Skinware."""


class ConfigurationError(SkinwareError, ValueError):
    """An option, a file or a name that a person wrote is wrong. Commands exit with 2."""


class StructureError(SkinwareError, ValueError):
    """The tables of a skin's structure contradict each other."""


class NamespaceError(SkinwareError):
    """The namespace's folder cannot be used: missing rights, a wrong owner, a symlink."""


class PlatformError(SkinwareError):
    """This machine lacks something that the core needs (memory fences, /dev/shm)."""


class RealtimeRefused(SkinwareError):
    """A real-time profile was not granted in full; one line for each thing says why, and how to get it."""


class ServiceError(SkinwareError):
    """Base class of errors between the writer and the readers of a service."""


class ServiceNotFound(ServiceError):
    """No service of this name has ever published in the namespace."""


class ServiceTimeout(ServiceError, TimeoutError):
    """No newer sample arrived before the deadline. The message says whether the writer is running."""


class NameInUse(ServiceError):
    """A running writer owns this name."""


class BadServiceFile(ServiceError):
    """A file in the namespace is not a service that this version can read; it was not mapped."""


class StructureChanged(ServiceError):
    """The service came back with another structure. Call ``reattach()`` to attach to it."""


class Overrun(ServiceError):
    """The writer overwrote the slot faster than it could be copied, several times in a row."""


class Closed(ServiceError):
    """The writer or reader was closed, or belongs to the process that this one was forked from."""


class Paused(ServiceError):
    """The writer publishes nothing and takes no requests until it resumes."""


class RequestError(ServiceError):
    """Base class of errors of requests: the request was not carried out, or it is unknown whether it was."""


class RequestTimeout(RequestError, TimeoutError):
    """No answer arrived in time. A late answer is never taken for the answer to another request."""


class RequestRefused(RequestError):
    """The service takes no such request: unknown operation, wrong arguments, or no requests at all."""


class RequestFailed(RequestError):
    """The operation was started and failed; the message is the writer's."""


class RequestCancelled(RequestError):
    """The request was cancelled by the program that sent it."""


class PeerGone(RequestError):
    """The service's writer is dead, or died or was restarted while the request was under way."""


class BadRecording(SkinwareError):
    """A file is not a recording that this version can read, or so damaged that nothing of it can be used."""


class BridgeError(SkinwareError):
    """Two machines cannot be connected, or do not understand each other."""


class MissingExtra(SkinwareError, ImportError):
    """Packages that only some need are not installed; the message says how to install them."""

    @classmethod
    def of(cls, what: str, requirement: str) -> MissingExtra:
        """Return the error for a purpose and what pip needs to install, such as ``skinware[record]``."""
        return cls(f"packages for {what} are not installed: pip install '{requirement}'")


class DriverError(SkinwareError):
    """A driver's own code failed; the message names bus, hook and cause.

    Attributes:
        bus: name of the bus that it failed for, "" if it concerns all.
    """

    def __init__(self, message: str, *, bus: str = "") -> None:
        super().__init__(message)
        self.bus = bus


class BusError(SkinwareError):
    """Base class of errors of a bus."""


class BusNotAvailable(BusError):
    """The bus does not exist, is down, or may not be opened. Commands exit with 1.

    Attributes:
        is_down: the interface is there, but down; otherwise it is not there (or not for us).
        reason: why, for programs; default: down or not there.
    """

    def __init__(self, message: str, *, is_down: bool = False, reason: BusReason | None = None) -> None:
        super().__init__(message)
        self.is_down = is_down
        self.reason: BusReason = (
            (BusReason.INTERFACE_DOWN if is_down else BusReason.INTERFACE_GONE) if reason is None else reason
        )


class BusSendError(BusError):
    """A frame could not be sent on the bus (down, full, or opened to listen only)."""


class HandshakeTimeout(BusError, TimeoutError):
    """A device did not answer a request in time."""
