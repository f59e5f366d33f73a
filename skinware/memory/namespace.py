"""A namespace: the folder in shared memory where services meet."""

from __future__ import annotations

import contextlib
import grp
import itertools
import os
import pwd
import re
import stat
from collections.abc import Iterator
from errno import EEXIST, ENOTEMPTY, EPERM
from pathlib import Path

from skinware.errors import ConfigurationError, NamespaceError

ROOT = Path("/dev/shm")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,46}")


def is_name(name: str) -> bool:
    return _NAME.fullmatch(name) is not None


def check_name(name: str, what: str) -> str:
    """``name`` itself, if it can name a service or a namespace.

    Raises:
        ConfigurationError: it cannot; the message says what can.
    """
    if name.endswith(".mcap"):
        raise ConfigurationError(
            f"{name} is a recording, and runs nowhere: skin-view {name} shows it, skin-replay {name} publishes it"
            f" again, skin-convert {name} --to npz writes it for numpy (csv, parquet, lerobot, ros2 ...)"
        )
    if not is_name(name):
        raise ConfigurationError(
            f"{what} name {name!r}: give 1 to 47 letters, digits, '_' or '-', beginning with a letter or digit"
        )
    return name


class Namespace:
    """A folder under /dev/shm, owned by the one user who runs its drivers.

    Everybody in the folder's group may read the services and announce readers; other accounts see nothing.

    Args:
        name: default: environment variable ``SKINWARE_NAMESPACE``, else ``default``.
        owner: a user (name or id) whose namespace is accepted besides one's own and root's; default: environment
            variable ``SKINWARE_OWNER``.

    Raises:
        ConfigurationError: an invalid name, or an unknown owner.
    """

    def __init__(self, name: str | None = None, *, owner: str | int | None = None) -> None:
        self.name: str = check_name(name or os.environ.get("SKINWARE_NAMESPACE") or "default", "namespace")
        self.path: Path = ROOT / f"skinware.{self.name}"
        self.readers_path: Path = self.path / "readers"
        self._extra_owner = _user_id(owner if owner is not None else os.environ.get("SKINWARE_OWNER"))

    @classmethod
    def of(cls, namespace: Namespace | str | None) -> Namespace:
        """Return a namespace itself, or the one of a name; None: the environment's."""
        return namespace if isinstance(namespace, Namespace) else cls(namespace)

    def create(self, group: str | None = None) -> None:
        """Make the folder if it is not there, and check that this user may write services into it.

        Args:
            group: give the folder to this group, whose members may then read.

        Raises:
            ConfigurationError: unknown group, or the folder is there and has another one.
            NamespaceError: the folder belongs to somebody else or cannot be made.
        """
        group_id = _group_id(group)
        try:
            for path, mode in ((self.path, 0o2750), (self.readers_path, 0o3770)):
                if not path.is_symlink() and not path.exists():
                    _make_folder(path, mode, group_id)
                owner = self.path.lstat().st_uid
                if owner != os.geteuid():
                    raise NamespaceError(
                        f"namespace {self.name!r} ({self.path}) belongs to {_user_name(owner)}: drivers must run as"
                        " that user, or in another namespace (SKINWARE_NAMESPACE)"
                    )
        except OSError as error:
            raise NamespaceError(f"cannot make {error.filename or self.path}: {error.strerror}") from None
        self.check()
        present = self.path.stat().st_gid
        if group is not None and present != group_id:
            raise ConfigurationError(
                f"namespace {self.name!r} ({self.path}) is one of {_group_name(present)}, not of group {group}:"
                " leave the group out, take another namespace, or stop what runs there and remove that folder"
            )

    def exists(self) -> bool:
        """Return whether any driver or service ever ran here since the machine was started."""
        return self.path.is_dir()

    def check(self) -> int:
        """Make sure that the folder is one that this user can trust.

        Returns:
            The user id of the folder's owner.

        Raises:
            NamespaceError: not there, a symlink, writable by others, or of an owner that is not accepted.
        """
        try:
            info = self.path.lstat()
        except FileNotFoundError:
            raise NamespaceError(
                f"namespace {self.name!r} is empty: no driver has run in it since the machine was started"
            ) from None
        if not stat.S_ISDIR(info.st_mode):
            raise NamespaceError(f"{self.path} is not a folder (a symlink is never followed); remove it")
        if info.st_mode & 0o022:
            mode = f"{info.st_mode & 0o7777:o}"
            raise NamespaceError(f"{self.path} can be written by others (mode {mode}); chmod 2750 it")
        accepted = {os.geteuid(), 0}
        if self._extra_owner is not None:
            accepted.add(self._extra_owner)
        if info.st_uid not in accepted:
            raise NamespaceError(
                f"namespace {self.name!r} ({self.path}) belongs to {_user_name(info.st_uid)}, who is neither you nor"
                " root; if that is right, set SKINWARE_OWNER to that user, else use another namespace (--namespace,"
                " SKINWARE_NAMESPACE)"
            )
        return info.st_uid

    def services(self) -> list[str]:
        """Return names of the services that have published here, living or dead, sorted; [] if there is no folder."""
        return sorted(self.service_inodes())

    def service_inodes(self) -> dict[str, int]:
        """Return the number of the file of every service that has published here, living or dead."""
        try:
            with os.scandir(self.path) as entries:
                return {entry.name[:-5]: entry.inode() for entry in entries if entry.name.endswith(".ring")}
        except FileNotFoundError:
            return {}
        except PermissionError:
            folder = self.path.stat()
            ask = f"ask {_user_name(folder.st_uid)} to add you to {_group_name(folder.st_gid)}"
            raise NamespaceError(
                f"{self.path} may not be read by {_user_name(os.geteuid())};"
                f" {ask if folder.st_gid else 'start its drivers with --group and a group of yours'}, or use another"
                " namespace (--namespace, SKINWARE_NAMESPACE)"
            ) from None
        except OSError as error:  # no descriptors left
            raise NamespaceError(f"{self.path} cannot be read: {error.strerror}") from None

    @property
    def calm_name(self) -> str:
        """Name of the namespace in which ``skin-calm`` publishes the drivers of this one, unless another is given."""
        return "calm" if self.name == "default" else f"{self.name}-calm"

    def ring_path(self, service: str) -> Path:
        """Return the file that readers of a service map."""
        return self.path / f"{service}.ring"

    def lock_path(self, service: str) -> Path:
        """Return the file whose lock is the ownership of a service's name."""
        return self.path / f"{service}.lock"

    def socket_path(self, service: str) -> Path:
        """Return where a service takes requests."""
        return self.path / f"{service}.sock"

    def reader_files(self, most: int | None = None) -> Iterator[Path]:
        """Yield the announcements of readers.

        Args:
            most: look at no more of them; default: at all.
        """
        try:
            with os.scandir(self.readers_path) as entries:
                names = sorted(entry.name for entry in itertools.islice(entries, most))
        except OSError:  # not there, not ours to read, or no descriptors left
            return
        for name in names:
            yield self.readers_path / name

    def __repr__(self) -> str:
        return f"<Namespace {self.name} at {self.path}>"


def _make_folder(path: Path, mode: int, group_id: int) -> None:
    """Make a folder that has its group and mode as soon as it can be seen, whoever dies or is faster meanwhile."""
    begun = path.with_name(f".{path.name}")
    try:
        with contextlib.suppress(FileExistsError):  # another driver's, or one that was killed here left it
            begun.mkdir(mode=0o700)
        folder = os.open(begun, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            if os.fstat(folder).st_uid != os.geteuid():
                raise PermissionError(EPERM, "the folder belongs to another account", str(begun))
            os.fchown(folder, -1, group_id)
            os.fchmod(folder, mode)
        finally:
            os.close(folder)
        os.rename(begun, path)
    except OSError as error:
        if not path.is_dir():
            raise
        if error.errno in (ENOTEMPTY, EEXIST):
            with contextlib.suppress(FileNotFoundError):
                begun.rmdir()


def _group_id(group: str | None) -> int:
    if group is None:
        return -1
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise ConfigurationError(f"there is no group {group!r} on this machine (see: getent group)") from None


def _group_name(group_id: int) -> str:
    try:
        return f"group {grp.getgrgid(group_id).gr_name}"
    except KeyError:
        return f"group {group_id}"


def _user_id(user: str | int | None) -> int | None:
    if user is None or user == "":
        return None
    if isinstance(user, int) or user.isdigit():
        return int(user)
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        raise ConfigurationError(f"there is no user {user!r} on this machine (SKINWARE_OWNER)") from None


def _user_name(user_id: int) -> str:
    try:
        return f"user {pwd.getpwuid(user_id).pw_name}"
    except KeyError:
        return f"user {user_id}"
