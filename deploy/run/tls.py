"""Encryption between a run's machines: one certificate of its own, which both ends know beforehand."""

import datetime
import ipaddress
import ssl
from pathlib import Path

from rmc.common.whole_file import write_private

CERTIFICATE, KEY = "tls-cert.pem", "tls-key.pem"
VALID = datetime.timedelta(days=3650)


def make_certificate(folder: Path, address: str = "127.0.0.1") -> None:
    """Write a self-signed certificate for a Redis at that address, and its key, into a folder, if none is there."""
    from cryptography import x509  # comes with Ray, which alone needs this
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    if (folder / CERTIFICATE).exists():
        return
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "rmc run")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))  # for clocks that differ
        .not_valid_after(now + VALID)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))]), critical=False)
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    private = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)
    for file, content in ((KEY, private), (CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM))):
        write_private(folder / file, content)


def server_context(folder: Path) -> ssl.SSLContext:
    """For who listens; certificate and key lie in ``folder``."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    return context


def client_context(folder: Path) -> ssl.SSLContext:
    """For who connects: takes this certificate and no other, whatever the server's name."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.load_verify_locations(folder / CERTIFICATE)
    return context
