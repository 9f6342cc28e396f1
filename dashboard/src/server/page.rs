//! The page itself: part of the program, compressed once, and the headers that keep a browser from doing anything else with it.

use std::io::Write;
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::http::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, IF_NONE_MATCH,
    REFERRER_POLICY, VARY, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use flate2::Compression;
use flate2::write::GzEncoder;
use ring::digest::{SHA256, digest};

const CSP: &str = "default-src 'self'; img-src 'self' blob:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

const FILES: [(&str, &str, &[u8]); 4] = [
    ("/", "text/html; charset=utf-8", include_bytes!("../../web/dist/index.html")),
    ("/app.js", "text/javascript; charset=utf-8", include_bytes!("../../web/dist/app.js")),
    ("/app.css", "text/css; charset=utf-8", include_bytes!("../../web/dist/app.css")),
    ("/icon.svg", "image/svg+xml", include_bytes!("../../web/dist/icon.svg")),
];

/// A file of the page.
pub struct File {
    /// Where.
    pub path: &'static str,
    kind: &'static str,
    plain: Bytes,
    zipped: Bytes,
    tag: String,
}

/// All files of the page.
pub fn files() -> Vec<Arc<File>> {
    let file = |(path, kind, content): (&'static str, &'static str, &'static [u8])| {
        let hash = digest(&SHA256, content);
        let tag = hash.as_ref().first_chunk().map_or(0, |first| u64::from_be_bytes(*first));
        Arc::new(File {
            path,
            kind,
            plain: Bytes::from_static(content),
            zipped: zip(content),
            tag: format!("\"{tag:016x}\""),
        })
    };
    FILES.into_iter().map(file).collect()
}

fn zip(content: &[u8]) -> Bytes {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    let zipped = encoder.write_all(content).and_then(|()| encoder.finish());
    zipped.expect("memory can be written to").into()
}

impl File {
    /// The answer to a request with these headers.
    pub fn answer(&self, asked: &HeaderMap) -> Response {
        let has = |name, wanted: &str| {
            let values = asked.get_all(name).iter().filter_map(|value| value.to_str().ok());
            values
                .flat_map(|value| value.split(','))
                .any(|each| each.split(';').next().unwrap_or_default().trim() == wanted)
        };
        let mut answer = if has(IF_NONE_MATCH, &self.tag) {
            StatusCode::NOT_MODIFIED.into_response()
        } else if has(ACCEPT_ENCODING, "gzip") {
            let mut answer = Body::from(self.zipped.clone()).into_response();
            answer.headers_mut().insert(CONTENT_ENCODING, HeaderValue::from_static("gzip"));
            answer
        } else {
            Body::from(self.plain.clone()).into_response()
        };
        let headers = answer.headers_mut();
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(self.kind));
        headers.insert(VARY, HeaderValue::from_static("accept-encoding"));
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        if let Ok(tag) = HeaderValue::from_str(&self.tag) {
            headers.insert(ETAG, tag);
        }
        answer
    }
}

/// What every answer says.
pub fn guard(mut answer: Response) -> Response {
    let headers = answer.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(CSP));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(X_FRAME_OPTIONS, HeaderValue::from_static("DENY"));
    headers.entry(CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    answer
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn files_are_zipped_for_those_who_can_read_it_and_known_ones_not_sent_again() {
        for file in files() {
            let mut headers = HeaderMap::new();
            let plain = file.answer(&headers);
            assert!(plain.headers().get(CONTENT_ENCODING).is_none(), "{}: nobody said gzip", file.path);
            headers.insert(ACCEPT_ENCODING, HeaderValue::from_static("br, gzip;q=0.9"));
            assert_eq!(file.answer(&headers).headers()[CONTENT_ENCODING], "gzip", "{}", file.path);
            let mut unzipped = Vec::new();
            flate2::read::GzDecoder::new(&file.zipped[..]).read_to_end(&mut unzipped).expect("gzip");
            assert_eq!(unzipped, file.plain, "{}: the same file", file.path);
            headers.insert(IF_NONE_MATCH, plain.headers()[ETAG].clone());
            assert_eq!(file.answer(&headers).status(), StatusCode::NOT_MODIFIED, "{}", file.path);
        }
    }
}
