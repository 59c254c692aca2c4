"""Signatures of gain sets: a key of the site (Ed25519) vouches for a set with its certificate.

Beside the file format. Seal and hashes are without a key: they show what changed by accident, and who means to computes
them again. A daemon that has `gains.signers` runs only what one of these keys has signed. The package `cryptography`
(extra `sign`) is imported where somebody signs or a signer is configured, and nowhere else.
"""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import Field

from servod.common.errors import BadInput
from servod.common.files import read_bytes
from servod.common.yaml import Strict

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

#: What is signed begins so: no signature of anything else counts as one of a gain set.
_CONTEXT = b"servod gain set, version 1\n"
_TYPE = "ssh-ed25519"
_MAKE = "an Ed25519 key, OpenSSH or PEM (`ssh-keygen -t ed25519` makes one)"


class GainSignature(Strict):
    """Who vouches for the set: the public key, and its signature over the hash of all but seal and signature."""

    key: str = Field(pattern=r"^[A-Za-z0-9+/]{43}=$", description="public key of the signer, 32 bytes in base64")
    value: str = Field(pattern=r"^[A-Za-z0-9+/]{86}==$", description="signature, 64 bytes in base64")

    @property
    def signer(self) -> str:
        """Fingerprint of the key, as ssh-keygen -l prints it."""
        return fingerprint(base64.b64decode(self.key))


def fingerprint(key: bytes) -> str:
    """Fingerprint of a public key of 32 bytes, as ssh-keygen -l prints it."""
    parts = (_TYPE.encode(), key)
    digest = hashlib.sha256(b"".join(struct.pack(">I", len(part)) + part for part in parts)).digest()
    return f"SHA256:{base64.b64encode(digest).decode().rstrip('=')}"


def load_private_key(path: str, ask: Callable[[], str | None]) -> Ed25519PrivateKey:
    """The site's key at `path`; `ask` gets its passphrase where it has one, None where nobody can be asked.

    Raises BadInput, ImportError without the extra.
    """
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    data = read_bytes(path, _MAKE)
    openssh = b"BEGIN OPENSSH PRIVATE KEY" in data
    load: Any = serialization.load_ssh_private_key if openssh else serialization.load_pem_private_key
    try:
        try:
            found = load(data, None)
        except TypeError:  # it has a passphrase
            word = ask()
            if word is None:
                raise BadInput(path, "a key with a passphrase, and no terminal to ask for it", "a terminal") from None
            found = load(data, word.encode())
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise BadInput(path, f"no private key that can be read ({error})", _MAKE) from None
    if not isinstance(found, Ed25519PrivateKey):
        raise BadInput(path, "a key of another kind", _MAKE)
    return found


def sign(content_sha256: str, key: Ed25519PrivateKey) -> GainSignature:
    """The signature of `key` over a set's content (GainSet.content_sha256)."""
    public = key.public_key().public_bytes_raw()
    value = key.sign(_CONTEXT + content_sha256.encode())
    return GainSignature(key=base64.b64encode(public).decode(), value=base64.b64encode(value).decode())


def require_signature(content_sha256: str, signature: GainSignature | None, signers: Sequence[str], where: str) -> None:
    """Refuse a set that none of `signers` has signed; without signers any may pass. Raises BadInput.

    `signers` are public keys as one line of OpenSSH, or files of them (OpenSSH, PEM); `where` names the set.
    """
    if not signers:
        return
    allowed = "one by a key of gains.signers (`servoctl verify --sign KEY`)"
    known = {key for signer in signers for key in _public_keys(signer)}
    if signature is None:
        raise BadInput(f"{where}: signature", "none, and gains.signers asks for one", allowed)
    key = base64.b64decode(signature.key)
    if key not in known:
        raise BadInput(f"{where}: signature", f"one by {signature.signer}, which is none of gains.signers", allowed)
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        public = Ed25519PublicKey.from_public_bytes(key)
        public.verify(base64.b64decode(signature.value), _CONTEXT + content_sha256.encode())
    except (InvalidSignature, ValueError):
        found = "one of another content: the set was changed after it was signed, or it is that of another set"
        raise BadInput(f"{where}: signature", found, allowed) from None


def is_key(signer: str) -> bool:
    """Whether an entry of gains.signers is a key itself and no file."""
    return signer.startswith(f"{_TYPE} ")


def _public_keys(signer: str) -> list[bytes]:
    """The keys of one entry of gains.signers, 32 bytes each. Raises BadInput, also where there are none."""
    where = f"gains.signers: {signer}"
    text = signer.encode() if is_key(signer) else read_bytes(signer, "public keys, OpenSSH or PEM")
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    except ImportError:
        raise BadInput(where, "a key, but no package cryptography to check it with", "servod[sign]") from None
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith(b"#")]
    pem = b"-----BEGIN PUBLIC KEY-----" in text
    try:
        load = serialization.load_pem_public_key if pem else serialization.load_ssh_public_key
        found = [load(one) for one in ([text] if pem else lines)]
    except (ValueError, UnsupportedAlgorithm) as error:
        raise BadInput(where, f"no public key that can be read ({error})", _MAKE) from None
    keys = [key.public_bytes_raw() for key in found if isinstance(key, Ed25519PublicKey)]
    if not keys or len(keys) < len(found):
        raise BadInput(where, "no key" if not found else "a key of another kind", _MAKE)
    return keys
