"""`servoctl verify`: judge a gain set by its own design, and write the certificate into it. No solver is imported."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servod.cli.common import JsonOption, example, one_thread, print_json, suggest
from servod.common.errors import AnswerIsNo, BadInput

if TYPE_CHECKING:
    from servod.formats.gains.gain_set import GainSet
    from servod.lab.verify.certify import Verification

EXAMPLE = "servoctl verify gains.yaml --json"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="verify", help=example("Certify a gain set, or say why not.", EXAMPLE))(verify)


def verify(
    gains: Annotated[Path, typer.Argument(help="Gain set, YAML, with its design.")],
    plants: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Plants of the Monte-Carlo; below 1000 nothing is certified.")
    ] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the drawn plants.")] = 1,
    processes: Annotated[int, typer.Option(min=1, max=64, help="Worker processes.")] = 2,
    write: Annotated[
        bool,
        typer.Option(
            help="Write the certificate, valid or not, into the file; a valid one is not revoked for want of plants."
        ),
    ] = True,
    sign: Annotated[
        Path | None,
        typer.Option(help="Sign a set that is valid with this private Ed25519 key, OpenSSH or PEM (extra sign)."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Verify GAINS; exit code 1 when the set is not valid."""
    one_thread()
    from servod.common.files import write_file
    from servod.formats.gains import signature
    from servod.formats.gains.gain_set import load_gains
    from servod.lab.verify.certify import verify

    checked = load_gains(gains)
    if sign is not None and not write:
        raise BadInput("--sign", "--no-write", "--write: a signature stands in the file")
    key = signature.load_private_key(str(sign), _passphrase) if sign else None
    result = verify(checked, plants, seed, processes, str(gains))
    signer = None
    if write and may_be_written(checked, result):
        judged = result.certified(checked)
        if key is not None and judged.certificate_problem() is None:
            judged = judged.model_copy(update={"signature": signature.sign(judged.content_sha256(), key)})
            signer = judged.signature and judged.signature.signer
        write_file(gains, judged.to_yaml())
    if as_json:
        print_json(result.document() | {"hashes": hashes(checked), "signed_by": signer})
    else:
        print_checks(result)
        print_hashes(hashes(checked))
        if signer:
            print(f"signed by {signer}")
    suggest("deploy", str(gains), why="tries it on the axis, and goes back by itself when it is worse")
    if not result.valid:
        failed = [check.name for check in result.checks if not check.passed]
        raise AnswerIsNo(f"{gains}: not valid: {'; '.join(failed)}")


def _passphrase() -> str | None:
    """Of the site's key, from the person at the terminal."""
    return str(typer.prompt("passphrase", hide_input=True, err=True)) if sys.stdin.isatty() else None


def may_be_written(gains: GainSet, result: Verification) -> bool:
    """Whether the result may be written: a look with few plants that finds no fault is no reason to end a certificate.

    Says so on standard error where it may not.
    """
    from servod.lab.verify.checks import PLANTS_CHECK

    against = [check.name for check in result.checks if not check.passed]
    if against != [PLANTS_CHECK] or gains.certificate_problem() is not None:
        return True
    print("the file keeps its valid certificate: these are too few plants to judge it", file=sys.stderr)
    return False


def hashes(gains: GainSet) -> dict[str, str | list[str] | None]:
    """What the set was made from, by hashes: the model's file, its recordings, the tool; and of the law itself."""
    origin = gains.provenance
    return {
        "parameters": gains.parameters_sha256(),
        "model": origin.model_sha256,
        "data": list(origin.data_sha256),
        "tool": origin.tool_sha256,
    }


def print_hashes(found: dict[str, str | list[str] | None]) -> None:
    """Print the hashes, shortened; the JSON has them whole."""
    for name, value in found.items():
        hashes = value if isinstance(value, list) else [value] if value else []
        more = f" and {len(hashes) - 1} more (--json has all)" if len(hashes) > 1 else ""
        print(f"hash  {name}: {hashes[0][:16] + more if hashes else 'not stated'}")


def print_checks(result: Verification) -> None:
    """Print the margins of the loop, every check with its figure, limit and margin, and what was observed.

    Checks that failed come first.
    """
    from servod.lab.verify.certify import STABILITY
    from servod.lab.verify.margins import MARGINS, describe_margins

    print(f"{STABILITY}: poles and margins are of constant speeds; from one to another simulations alone show it")
    if margins := describe_margins(result.observations):
        print(f"{margins} (each least over all speeds, at the drive's torque command)")
    for check in sorted(result.checks, key=lambda check: check.passed):
        mark = "pass" if check.passed else "FAIL"
        print(f"{mark}  {check.name}: {check.value:.6g} (limit {check.limit:.6g}, margin {check.margin:.3g})")
    for name, value in result.observations.items():
        if name in MARGINS:
            continue
        print(f"told  {name}: {value:.6g}")
