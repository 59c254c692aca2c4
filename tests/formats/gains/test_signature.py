"""Signatures of gain sets: what is refused where the configuration names signers; keys as ssh-keygen makes them."""

from __future__ import annotations

import asyncio
import base64
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from servod.cli.app import run
from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import GainSet, load_gains, parse_gains, require_certificate, require_signed
from servod.formats.gains.signature import load_private_key, sign
from servod.lab.verify import certify
from servod.runtime.daemon.arguments import GainsLoadArgs
from servod.runtime.daemon.gain_bank import GainBank

OPENSSH, PEM = serialization.PrivateFormat.OpenSSH, serialization.PrivateFormat.PKCS8
SITE = Ed25519PrivateKey.generate()


def public(key: Ed25519PrivateKey, pem: bool = False) -> str:
    form = (
        (serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
        if pem
        else (serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH)
    )
    return key.public_key().public_bytes(*form).decode()


def private(key: object, form: serialization.PrivateFormat = OPENSSH, word: bytes = b"") -> bytes:
    lock = serialization.BestAvailableEncryption(word) if word else serialization.NoEncryption()
    text: bytes = key.private_bytes(serialization.Encoding.PEM, form, lock)  # type: ignore[attr-defined]
    return text


def asking(folder: Path, *signers: str) -> AxisConfig:
    """The virtual axis's configuration with these signers, read from a file."""
    text = shipped("gains/config/virtual.yaml").read_text()
    listed = "".join(f"\n    - {signer!r}" for signer in signers)
    (folder / "axis.yaml").write_text(text.replace("gains:\n", f"gains:\n  signers:{listed or ' []'}\n", 1))
    return load_config(folder / "axis.yaml")


def signed(gains: GainSet, key: Ed25519PrivateKey = SITE) -> GainSet:
    return gains.model_copy(update={"signature": sign(gains.content_sha256(), key)})


CERTIFIED = load_gains(shipped("gains/demo_local_certified.yaml"))


def bent() -> GainSet:
    """A number of it changed after it was signed, and sealed again, as who means to does."""
    whole = signed(CERTIFIED)
    return whole.model_copy(update={"description": "bent"}).sealed()


def by_hand() -> GainSet:
    """Another law's numbers under a certificate that was written by hand, with all its hashes; not signed."""
    parameters = CERTIFIED.parameters.model_copy(update={"input_scale_nm": 5.0})
    found = CERTIFIED.model_copy(update={"parameters": parameters})
    assert found.certificate is not None
    right = found.certificate.model_copy(update={"parameters_sha256": found.parameters_sha256()})
    found = found.model_copy(update={"certificate": right}).sealed()
    require_certificate(found, accept_uncertified=None)  # hashes alone let it pass
    return found


def moved() -> GainSet:
    """The signature of another set of the site's."""
    return by_hand().model_copy(update={"signature": signed(CERTIFIED).signature})


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: CERTIFIED, "none, and gains.signers asks for one"),
        (by_hand, "none, and gains.signers asks for one"),
        (lambda: signed(by_hand(), Ed25519PrivateKey.generate()), "which is none of gains.signers"),
        (bent, "one of another content"),
        (moved, "one of another content"),
    ],
)
def test_a_set_that_no_signer_has_signed_is_refused(made: Callable[[], GainSet], says: str, tmp_path: Path) -> None:
    """Not signed, by hand, by another key, bent afterwards, signature of another set: all pass by their hashes."""
    gains = made()
    assert gains.certificate_problem() is None
    require_signed(gains, asking(tmp_path))
    with pytest.raises(BadInput, match=says):
        require_signed(gains, asking(tmp_path, public(SITE)), "set.yaml")


def test_signers_are_lines_or_files_beside_the_configuration(tmp_path: Path) -> None:
    """One of several keys is enough; the set survives its file, and a comment in it."""
    gains = parse_gains(f"# released\n{signed(CERTIFIED).to_yaml()}", "set.yaml")
    other = Ed25519PrivateKey.generate()
    (tmp_path / "site.pub").write_text(f"# line 3\n{public(other)} a\n{public(SITE)} b@c\n")
    (tmp_path / "site.pem").write_text(public(SITE, pem=True))
    for signers in (["site.pub"], ["site.pem"], [public(other), f"{public(SITE)} comment"]):
        require_signed(gains, asking(tmp_path, *signers))
    for text, says in (("", "no key"), ("ssh-ed25519 AAAA", "no public key"), (public(other)[:-9], "no public key")):
        (tmp_path / "bad.pub").write_text(text)
        with pytest.raises(BadInput, match=rf"gains.signers: .*bad.pub: found {says}"):
            require_signed(gains, asking(tmp_path, "bad.pub"))
    with pytest.raises(BadInput, match=r"gone.pub: there is no such file"):
        require_signed(gains, asking(tmp_path, "gone.pub"))


def test_every_byte_of_a_signature_counts(tmp_path: Path) -> None:
    config, whole = asking(tmp_path, public(SITE)), signed(CERTIFIED)
    assert whole.signature is not None
    value = base64.b64decode(whole.signature.value)
    for at in range(len(value)):
        turned = base64.b64encode(value[:at] + bytes([value[at] ^ 1]) + value[at + 1 :]).decode()
        with pytest.raises(BadInput):
            require_signed(
                whole.model_copy(update={"signature": whole.signature.model_copy(update={"value": turned})}), config
            )


def test_the_daemon_neither_starts_with_nor_loads_an_unsigned_set(tmp_path: Path) -> None:
    """Although it accepts sets without a certificate."""
    config = asking(tmp_path, public(SITE))

    def of(initial: GainSet) -> AxisConfig:
        (tmp_path / "initial.yaml").write_text(initial.to_yaml())
        update = {"directory": tmp_path / "store", "initial": tmp_path / "initial.yaml", "accept_uncertified": True}
        return config.model_copy(update={"gains": config.gains.model_copy(update=update)})

    plain = load_gains(shipped("gains/demo_pd.yaml")).sealed()
    with pytest.raises(BadInput, match=r"gains\.signers asks for one"):
        GainBank(of(plain))
    bank = GainBank(of(signed(plain)))
    with ThreadPoolExecutor(1) as slow:
        for name, gains in (("plain.yaml", CERTIFIED), ("bent.yaml", bent())):
            with pytest.raises(BadInput, match=f"{name}: signature"):
                asyncio.run(bank.load(GainsLoadArgs(text=gains.to_yaml(), name=name), slow))
        assert asyncio.run(bank.load(GainsLoadArgs(text=signed(CERTIFIED).to_yaml(), name="a.yaml"), slow))["certified"]


def test_keys_are_read_as_ssh_keygen_makes_them(tmp_path: Path) -> None:
    """OpenSSH and PEM, with and without a passphrase; any other file is refused in one line."""
    path = tmp_path / "key"
    for form in (OPENSSH, PEM):
        for word in (b"", b"open"):
            path.write_bytes(private(SITE, form, word))
            assert load_private_key(str(path), lambda: "open").private_bytes_raw() == SITE.private_bytes_raw()
            if word:
                for answer, says in ((None, "no terminal"), ("wrong", "no private key that can be read")):
                    with pytest.raises(BadInput, match=says):
                        load_private_key(str(path), lambda answer=answer: answer)  # type: ignore[misc]
    for data, says in (
        (private(generate_private_key(SECP256R1())), "a key of another kind"),
        (public(SITE).encode(), "no private key that can be read"),
        (b"", "no private key that can be read"),
    ):
        path.write_bytes(data)
        with pytest.raises(BadInput, match=says):
            load_private_key(str(path), lambda: None)


def test_verify_signs_what_is_valid_and_only_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(certify, "verify", partial(certify.verify, least_plants=50))  # enough for a signature
    key, file = tmp_path / "key", tmp_path / "set.yaml"
    key.write_bytes(private(SITE))
    file.write_text(CERTIFIED.to_yaml())
    assert run(["verify", str(file), "--sign", str(key), "--no-write"]) == 2
    assert "a signature stands in the file" in capsys.readouterr().err
    assert run(["verify", str(file), "--sign", str(key), "--plants", "50"]) == 0
    made, config = load_gains(file), asking(tmp_path, public(SITE))
    require_signed(made, config)
    assert made.signature is not None and f"signed by {made.signature.signer}" in capsys.readouterr().out
    assert run(["gains", "show", str(file)]) == 0
    assert f"signature: by {made.signature.signer}" in capsys.readouterr().out
    file.write_text(by_hand().to_yaml())
    assert run(["verify", str(file), "--sign", str(key)]) == 1
    assert load_gains(file).signature is None


def test_without_signers_nobody_needs_the_package() -> None:
    script = "import sys, servod.runtime.daemon.main; sys.exit('cryptography' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
