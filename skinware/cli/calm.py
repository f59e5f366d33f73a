"""``skin-calm``: publish a driver with baselines that hold."""

from __future__ import annotations

import contextlib
import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    examples,
    group_option,
    json_option,
    log_to_stderr,
    namespace_option,
    run,
    signals_end,
    verbose_option,
    version_option,
    warn,
)
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware.tactile.calm_service import CalmService


@click.command(
    "skin-calm",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-calm torso                        skin-top --namespace calm shows it",
        "skin-calm torso --config chain.toml    with a filter, or in N",
        "skin-calm torso --regions parts.toml   and where to what touches its parts moves",
        "skin-calm torso --into quiet           into another namespace",
    ),
)
@click.argument("name")
@click.option(
    "--into",
    metavar="NAMESPACE",
    help="Where the calmed driver is.  [default: calm; of drivers in another namespace than 'default', NAMESPACE-calm]",
)
@click.option(
    "--config",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="TOML file with the stages: baseline, curve, filter, scaler, amplifier.  [default: a baseline]",
)
@click.option(
    "--state",
    "state_path",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Where baselines and health are kept over a restart.  [default: below $STATE_DIRECTORY or ~/.local/state]",
)
@click.option(
    "--contacts",
    metavar="NAME",
    default="contacts",
    show_default=True,
    help="Name of the service of its contacts, beside it; NAME-contacts, if that is taken; empty: none.",
)
@click.option(
    "--regions",
    "region_files",
    multiple=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="File with regions, whose motion is published beside the contacts; repeat it for several.",
)
@click.option("--motion", metavar="NAME", default="motion", show_default=True, help="Name of the service of motion.")
@click.option(
    "--health",
    metavar="NAME",
    default="health",
    show_default=True,
    help="Name of the service of its sensors' health, beside it; empty: none, and no sensor is marked.",
)
@group_option
@namespace_option
@json_option
@version_option
@verbose_option
def command(
    name: str,
    into: str | None,
    config: Path | None,
    state_path: Path | None,
    contacts: str,
    region_files: tuple[Path, ...],
    motion: str,
    health: str,
    group: str | None,
    namespace: str | None,
    as_json: bool,
    verbose: bool,
) -> None:
    """Calm driver NAME: 0 = no touch, whatever drifts, under the same name in another namespace.

    The first seconds it measures what untouched sensors read. It goes on when the driver restarts or changes; what it
    learned is kept for 10 minutes over a restart of its own. Programs may ask it to tare, hold and change settings.
    Beside the driver it publishes its contacts, of pressure sensors if there are any, and the health of its sensors:
    stuck, noisy, clipped, dead and weak ones have the status UNHEALTHY (skin-info --health tells why).

    Exit status: 0 interrupted, 1 failed, 2 wrong usage or configuration.
    """
    from skinware.memory.namespace import Namespace, check_name
    from skinware.tactile.calm_service import CalmService
    from skinware.tactile.chain import ChainSettings
    from skinware.tactile.chain_state import default_path
    from skinware.tactile.derived_services import WatchedRegions
    from skinware.tactile.regions import read_regions

    log_to_stderr(verbose)
    check_name(name, "driver")
    for service_name in filter(None, (contacts, motion, health)):
        check_name(service_name, "service")
    settings = ChainSettings.calm() if config is None else ChainSettings.read(config)
    source = Namespace(namespace)
    target = Namespace(into or source.calm_name)
    service = CalmService(
        name,
        settings,
        namespace=source,
        into=target,
        group=group,
        state_path=state_path or default_path(target.name, name),
        contacts=contacts or None,
        watched=WatchedRegions(read_regions(*region_files), motion) if region_files else None,
        health=health or None,
    )
    services = source.services()
    if name not in services:
        nearest = difflib.get_close_matches(name, services, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else "."
        there_are = ", ".join(services) or "none"
        warn(f"waiting for driver {name!r} in {source.name!r}{hint} There are: {there_are}")
    with signals_end(service.stop):
        report = (lambda: _tell_status(service)) if as_json else lambda: None
        service.run(report, on_ready=lambda: _tell_ready(service, as_json))
    if as_json:
        with contextlib.suppress(BrokenPipeError):
            print_json({"event": "stopped", "name": service.name, **service.status()})


def _tell_ready(service: CalmService, as_json: bool) -> None:
    chain = service.chain
    if chain is None:
        return
    structure = chain.structure
    units = {sensor_type.name: sensor_type.unit for sensor_type in structure.types}
    beside = _services_beside(service)
    if as_json:
        ready: dict[str, Any] = {"event": "ready", "driver": "calm", "name": service.name}
        counts = {"sensors": structure.n_sensors, "modules": structure.n_modules, "patches": structure.n_patches}
        types = {t.name: int((structure.sensor_type == t.id).sum()) for t in structure.types}
        where = {"namespace": service.namespace.name, "into": service.into.name, **beside}
        stages = [{"type": name, "stage": stage.name} for name, of_type in chain.stages.items() for stage in of_type]
        print_json(
            {**ready, **counts, "types": types, "units": units, **where, "stages": stages, "restored": service.restored}
        )
    else:
        through = [
            f"{name} [{units[name]}] through {', '.join(s.name for s in st)}" for name, st in chain.stages.items() if st
        ]
        restored = f"; goes on with {service.restored} baselines" if service.restored else ""
        echo(f"{service.name}: {'; '.join(through) or 'nothing changed'}{restored}")
        there = ", ".join(filter(None, beside.values()))
        there = f" and, beside it, {there}" if there else ""
        echo(f"publishing it{there} (skin-top --namespace {service.into.name} shows it, Ctrl-C ends)")


def _services_beside(service: CalmService) -> dict[str, str]:
    """Names of the services of contacts, motion and health; empty: there is none."""
    contacts, health = service.contacts, service.health
    return {
        "contacts": contacts.name if contacts is not None else "",
        "motion": contacts.motion.name if contacts is not None and contacts.motion is not None else "",
        "health": health.name if health is not None else "",
    }


def _tell_status(service: CalmService) -> None:
    try:
        print_json({"event": "status", "name": service.name, **service.status()})
    except BrokenPipeError:
        service.stop()


def main() -> None:
    run(command, goes_on=True)
