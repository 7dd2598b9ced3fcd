"""Make the prior of stage=identify from stated values (identify.prior.PARAMETER.mean=) and identify.from=."""

from dataclasses import dataclass, replace
from typing import Any

from r2s.errors import UserError
from r2s.files import run_file
from r2s.stages.build import modules
from r2s.stages.parts import called, plain
from r2s.stages.run_config import loaded


@dataclass(frozen=True)
class Earlier:
    """An earlier identification: folder, kind of torque, parameter space, values x (P,) and posterior draws (S, P).

    drift: value of identify.drift. given: True for the run that identify.from= names, False for a fit in this job.
    """

    run: str
    torque: str
    space: Any
    x: Any
    samples: Any
    drift: float = 0.0
    given: bool = False

    def __str__(self):
        """Return the name of this identification for messages."""
        return self.run if self.given else f"{self.torque} torque"

    @property
    def arm(self):
        """The identified dynamics without the estimated payload, which r2s estimates anew."""
        x = self.x.copy()
        if "payload_mass" in self.space.blocks:
            x[self.space.where("payload_mass")] = 0.0
        return self.space.dynamics(x)


def earlier_run(cfg, robot):
    """Return the identification that identify.from= names as an `Earlier`, or None if identify.from is unset.

    Raises:
        UserError: the run has no identification of this robot, or calibration= is also set.
    """
    from r2s.identification.parameter_file import load_parameters, load_posterior

    run, option = cfg.identify.get("from"), "identify.from"  # older configs lack this key
    if run is None:
        return None
    run = str(run)
    if cfg.calibration:
        raise UserError(f"{option}: {run} is the arm to start from; leave calibration={cfg.calibration} out")
    space, x = load_parameters(run, robot, modules(cfg.get("trust")), option)
    path = run_file(run, "parameters.yaml", option)
    torque = (loaded(path).get("source") or {}).get("torque", "commanded")
    return Earlier(run, torque, space, x, load_posterior(run, space, option), cfg.identify.drift, True)


def make_settings(cfg, torque, earlier=(), last=True):
    """Return the `Settings` of an identification from torque of the kind `torque`.

    Args:
        earlier: list of `Earlier`, whose links and payload enter the prior. If an `Earlier` has the same kind of
            torque, all its values enter the prior, and the new model has the same friction family and terms.
        last: whether `torque` is the last kind that r2s fits. Fits of earlier kinds use only the stated values of
            links and payload.
    """
    from r2s.identification.known import BODY, Known, block_of
    from r2s.identification.settings import Settings
    from r2s.identification.stated import with_terms_of
    from r2s.identification.terms import TERMS, add_terms, blocks_of, optional_friction
    from r2s.physics.friction import family_path
    from r2s.recordings.recording import TORQUES

    settings: dict[str, Any] = plain(cfg.identify)
    for key in ("validation_fraction", "from", "drift", "gears"):
        settings.pop(key, None)
    every = [*optional_friction(), *TERMS]
    stated = {k: v for k, v in settings["prior"].items() if k not in TORQUES and (last or k in BODY)}
    for key in ("terms", "prior", "candidate_terms", "prunable_terms"):
        settings[key] = settings[key][torque]
    terms, kept, family = settings["terms"], [t for t in every if {*blocks_of(t)} & {*stated}], cfg.friction.family
    known: Known | None = None
    for before in earlier:
        own, blocks = Known.of(before.space, before.x, before.samples, before.drift), {*before.space.blocks}
        if before.torque == torque:
            family = family_path(before.space.nominal.family)
            terms = kept = [t for t in every if blocks_of(t)[0] in blocks]
            settings |= {"candidate_terms": [], "prunable_terms": []}
        else:
            own = own.where(lambda name: block_of(name) in BODY)
            shared = [t for t in ("link", "payload") if {*blocks_of(t)} & blocks]
            kept, terms = [*kept, *shared], add_terms(terms, [t for t in shared if t not in terms])
        known = own if known is None else known.beside(own)
    settings["known"] = known
    terms = with_terms_of(stated, terms, blocks_of, every)
    settings |= {"terms": terms, "prunable_terms": [t for t in settings["prunable_terms"] if t not in kept]}
    settings["candidate_terms"] = [t for t in settings["candidate_terms"] if t not in terms]
    if "inertia_scale" in stated:
        settings["candidate_terms"] = [t for t in settings["candidate_terms"] if t != "link"]
    settings |= {"family": family, "stated": stated, "seed": cfg.seed, "nthread": cfg.threads}
    return called(Settings, "identify", settings)


def check_known(robot, nominal, recording, settings):
    """Raise UserError if a stated value does not fit the arm, or if its parameter does not affect the recording."""
    from r2s.identification.stated import check_stated, stated_prior
    from r2s.identification.terms import scaled_prior, search_space
    from r2s.physics.dynamics import with_family

    check_stated(settings.stated, robot.n)
    if settings.stated:
        own = nominal if settings.family == "auto" else with_family(nominal, settings.family)
        space = search_space(robot, own, settings.bounds, settings.terms, recording, settings.stated)
        stated_prior(space, settings.stated, scaled_prior(settings.prior, robot, recording, own))


def start_of(nominal, earlier, torque):
    """Return a fit's start model: `earlier.arm`; for another kind of torque, `nominal` with the earlier links."""
    arm = earlier.arm
    if earlier.torque == torque:
        return arm
    return replace(nominal, mass=arm.mass, com=arm.com, inertia=arm.inertia)
