//! The car's own certificate authority: signs the certificate that the car shows, and those in the keys that it grants.
//!
//! Validity begins in 1970 and ends in 2100: cars have no battery-backed clock, and a key is ended by `carril revoke`, not by time.

use std::net::IpAddr;

use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, SanType, date_time_ymd,
};
use ring::digest::{SHA256, digest};
use serde::{Deserialize, Serialize};

/// A certificate could not be made or read.
#[derive(Debug, thiserror::Error)]
#[error("certificate: {0}")]
pub struct CertificateError(#[from] rcgen::Error);

/// A certificate and its private key, as PEM texts.
#[derive(Clone, Serialize, Deserialize)]
pub struct Pair {
    /// The certificate.
    pub certificate: String,
    /// The private key.
    pub key: String,
    /// SHA-256 of the certificate, as browsers show it: `AB:CD:...`
    pub fingerprint: String,
}

fn parameters(common_name: &str) -> CertificateParams {
    let mut parameters = CertificateParams::default();
    parameters.distinguished_name = DistinguishedName::new();
    parameters.distinguished_name.push(DnType::CommonName, common_name);
    parameters.not_before = date_time_ymd(1970, 1, 1);
    parameters.not_after = date_time_ymd(2100, 1, 1);
    parameters
}

/// Makes an authority.
pub fn make_authority(robot: &str) -> Result<Pair, CertificateError> {
    let key = KeyPair::generate()?;
    let certificate = authority_parameters(robot).self_signed(&key)?;
    Ok(pair(&certificate, &key))
}

fn authority_parameters(robot: &str) -> CertificateParams {
    let mut parameters = parameters(&format!("carril {robot}"));
    parameters.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    parameters.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    parameters
}

/// Signs a certificate for the car, under all its names and addresses.
pub fn sign_server(
    authority: &Pair,
    robot: &str,
    names: &[String],
    addresses: &[IpAddr],
) -> Result<Pair, CertificateError> {
    let mut parameters = parameters(&format!("carril {robot}"));
    for name in names {
        parameters.subject_alt_names.push(SanType::DnsName(name.as_str().try_into()?));
    }
    parameters.subject_alt_names.extend(addresses.iter().copied().map(SanType::IpAddress));
    parameters.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    sign(authority, robot, &parameters)
}

/// Signs a certificate for the holder of a key.
pub fn sign_client(authority: &Pair, robot: &str, name: &str) -> Result<Pair, CertificateError> {
    let mut parameters = parameters(name);
    parameters.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
    sign(authority, robot, &parameters)
}

fn sign(authority: &Pair, robot: &str, parameters: &CertificateParams) -> Result<Pair, CertificateError> {
    let issuer = Issuer::new(authority_parameters(robot), KeyPair::from_pem(&authority.key)?);
    let key = KeyPair::generate()?;
    let certificate = parameters.signed_by(&key, &issuer)?;
    Ok(pair(&certificate, &key))
}

fn pair(certificate: &rcgen::Certificate, key: &KeyPair) -> Pair {
    Pair { certificate: certificate.pem(), key: key.serialize_pem(), fingerprint: fingerprint(certificate.der()) }
}

/// SHA-256 as browsers show it.
pub fn fingerprint(bytes: &[u8]) -> String {
    let hash = digest(&SHA256, bytes);
    hash.as_ref().iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(":")
}
