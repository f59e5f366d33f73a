"""``skin-calm``: publish a driver with 0 where nothing touches it."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware.tactile.calm_service import CalmService


@cli.command(
    "skin-calm",
    "skin-calm                              the only driver; skin-top --namespace calm shows it",
    "skin-calm torso --config chain.toml    with a filter, or in N",
    "skin-calm torso --regions parts.toml   with the motion of touches over its parts",
    "skin-calm torso --into quiet           into another namespace",
)
@click.argument("name", required=False)
@click.option(
    "--into",
    metavar="NAMESPACE",
    help="Namespace of the calmed driver.  [default: calm; NAMESPACE-calm for drivers outside 'default']",
)
@click.option(
    "--config",
    metavar="FILE",
    type=cli.FILE,
    help="TOML file with the stages: field, thermal, baseline, vector, curve, filter, scaler, amplifier.  [default: a"
    " baseline]",
)
@click.option(
    "--state",
    "state_path",
    metavar="FILE",
    type=cli.FILE,
    help="File that keeps baselines and health over a restart.  [default: below $STATE_DIRECTORY or ~/.local/state]",
)
@click.option(
    "--contacts",
    metavar="NAME",
    default="contacts",
    help="Name of the service of its contacts; NAME-contacts if that is taken; empty: none.",
)
@cli.regions_option("File with regions whose motion is published; may be repeated.")
@cli.links_option("Links of the robot, as for skin-view: contacts hang together across the borders of links.")
@click.option("--motion", metavar="NAME", default="motion", help="Name of the service of motion.")
@click.option(
    "--health",
    metavar="NAME",
    default="health",
    help="Name of the service of its sensors' health; empty: none, and no sensor is marked.",
)
@cli.group_option
@cli.namespace_option
@cli.json_option
@cli.verbose_option
def command(
    name: str | None,
    into: str | None,
    config: Path | None,
    state_path: Path | None,
    contacts: str,
    region_files: tuple[Path, ...],
    links: Path | None,
    motion: str,
    health: str,
    group: str | None,
    namespace: str | None,
    as_json: bool,
    verbose: bool,
) -> None:
    """Publish driver NAME, or the only one, again in another namespace, with 0 where nothing touches it.

    In the first seconds the unpressed skin is measured. Restarts and changes of the driver do not end it. A restart of
    skin-calm itself keeps baselines for 10 minutes. Programs can call operations: tare, hold, change settings. It also
    publishes the contacts of the driver, of pressure sensors if there are any, and the health of its sensors: those
    with a fault (stuck, noisy, dead ...) get the status UNHEALTHY (skin-info --health shows why).

    Exit status: 0 interrupted, 1 failed, 2 wrong usage or configuration.
    """
    from skinware.memory.namespace import Namespace, check_name
    from skinware.tactile.calm_service import CalmService
    from skinware.tactile.chain import ChainSettings
    from skinware.tactile.chain_state import default_path
    from skinware.tactile.regions import read_regions
    from skinware.text import nearest_name
    from skinware.views.live import only_driver
    from skinware.views.robot import read_robot

    cli.log_to_stderr(verbose)
    source = Namespace(namespace)
    name = name or only_driver(source, "skin-calm NAME")
    check_name(name, "driver")
    for service_name in filter(None, (contacts, motion, health)):
        check_name(service_name, "service")
    settings = ChainSettings.calm() if config is None else ChainSettings.read(config)
    target = Namespace(into or source.calm_name)
    service = CalmService(
        name,
        settings,
        namespace=source,
        into=target,
        group=group,
        state_path=state_path or default_path(target.name, name),
        contacts=contacts or None,
        regions=read_regions(*region_files) if region_files else None,
        motion=motion,
        poses=read_robot(links).poses if links else None,
        health=health or None,
    )
    services = source.services()
    if name not in services:
        cli.warn(f"waiting for driver {name!r} in {source.name!r}{nearest_name(name, services)}")

    def report() -> None:
        try:
            print_json({"event": "status", "name": service.name, **service.status()})
        except BrokenPipeError:
            service.stop()

    with cli.signals_end(service.stop):
        service.run(report if as_json else lambda: None, on_ready=lambda: _report_ready(service, as_json))
    if as_json:
        with contextlib.suppress(BrokenPipeError):
            print_json({"event": "stopped", "name": service.name, **service.status()})


def _report_ready(service: CalmService, as_json: bool) -> None:
    chain = service.chain
    if chain is None:
        return
    structure = chain.structure
    units = {sensor_type.name: sensor_type.unit for sensor_type in structure.types}
    beside = {  # empty: there is none
        "contacts": service.contacts.name,
        "motion": service.motion.name,
        "health": service.health.name,
    }
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
        services = ", ".join(filter(None, beside.values()))
        services = f" and, beside it, {services}" if services else ""
        echo(f"publishing it{services} (skin-top --namespace {service.into.name} shows it, Ctrl-C ends)")


main = partial(cli.run, command, goes_on=True)
