//! A page as the dashboard's server sees it: HTTP and one WebSocket, plain or over TLS, on this machine.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::handshake::client::Request;
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

use super::HANGS_AFTER;

/// What a page talks through.
pub trait Line: Read + Write + Send {}
impl<T: Read + Write + Send> Line for T {}

/// A connection to the server; with the certificate of the authority that it trusts, over TLS.
pub fn connect(address: SocketAddr, authority: Option<&str>) -> Box<dyn Line> {
    connect_by(tcp(address), address, authority)
}

fn tcp(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(HANGS_AFTER)).expect("a socket has timeouts");
    // As browsers do.
    stream.set_nodelay(true).expect("TCP can do that");
    stream
}

fn connect_by(stream: TcpStream, address: SocketAddr, authority: Option<&str>) -> Box<dyn Line> {
    let Some(authority) = authority else { return Box::new(stream) };
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(authority.as_bytes()).expect("PEM")).expect("a certificate");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().expect("versions");
    let config = config.with_root_certificates(roots).with_no_client_auth();
    let name = match address.ip() {
        ip if ip.is_loopback() => ServerName::try_from("localhost").expect("a name"),
        ip => ServerName::IpAddress(ip.into()),
    };
    let connection = ClientConnection::new(Arc::new(config), name).expect("a client");
    Box::new(StreamOwned::new(connection, stream))
}

/// What an HTTP request came to.
#[derive(Debug)]
pub struct Answer {
    /// `200`
    pub status: u16,
    /// Headers as they came, in lower case.
    pub head: String,
    /// What follows.
    pub body: String,
}

impl Answer {
    /// The body as JSON.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }

    /// The value of a cookie that was set, for the next request.
    pub fn cookie(&self) -> String {
        let line = self.head.lines().find_map(|line| line.strip_prefix("set-cookie: ")).expect("a cookie");
        line.split(';').next().expect("a value").to_owned()
    }
}

/// Sends an HTTP request as it is written.
pub fn request(line: &mut dyn Line, text: &str) -> Answer {
    line.write_all(text.as_bytes()).expect("the server reads");
    let mut answer = Vec::new();
    // It closes, as it was asked to; TLS may end without goodbye.
    let _ = line.read_to_end(&mut answer);
    let answer = String::from_utf8_lossy(&answer);
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
    Answer { status, head: head.to_lowercase().replace("\r\n", "\n"), body: body.to_owned() }
}

/// `GET path`, with more headers.
pub fn get(address: SocketAddr, path: &str, headers: &str) -> Answer {
    let text = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{headers}\r\n");
    request(&mut *connect(address, None), &text)
}

/// `POST path` with JSON, over TLS if there is an authority.
pub fn post(address: SocketAddr, authority: Option<&str>, path: &str, body: &Value) -> Answer {
    let (host, body) = (host(address, authority), body.to_string());
    let text = format!(
        "POST {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    );
    request(&mut *connect(address, authority), &text)
}

fn host(address: SocketAddr, authority: Option<&str>) -> String {
    let by_name = authority.is_some() && address.ip().is_loopback();
    if by_name { format!("localhost:{}", address.port()) } else { address.to_string() }
}

/// An image as it came.
pub struct Picture {
    /// Its header.
    pub header: Value,
    /// The file.
    pub jpeg: Vec<u8>,
}

/// The picture, if all pieces of it have come.
fn whole(pieces: &[u8]) -> Option<Picture> {
    let (length, rest) = pieces.split_first_chunk::<4>()?;
    let (header, jpeg) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    let header: Value = serde_json::from_slice(header).expect("the header is JSON");
    let bytes = header["bytes"].as_u64().expect("it says how long the picture is") as usize;
    assert!(jpeg.len() <= bytes, "no more than it says");
    (jpeg.len() == bytes).then(|| Picture { header, jpeg: jpeg.to_vec() })
}

/// What [`Page::poll`] found.
pub enum Polled {
    /// A text or an image.
    Came(Result<Value, Picture>),
    /// Nothing so far.
    Nothing,
    /// The end of the connection.
    Ended,
}

/// A page that is open.
pub struct Page {
    socket: WebSocket<Box<dyn Line>>,
    stream: TcpStream,
    /// Of an image that comes in pieces.
    pieces: Vec<u8>,
    next_id: u64,
    /// The newest time of the car that came.
    pub seen_ms: f64,
    /// Every text that came.
    pub heard: Vec<Value>,
}

impl Page {
    /// Opens one and takes the greeting.
    #[track_caller]
    pub fn open(address: SocketAddr) -> Self {
        Self::try_open(address, None, &[]).unwrap_or_else(|error| panic!("a page opens: {error}"))
    }

    /// Opens one with more headers, over TLS if there is an authority. The status if it is refused.
    pub fn try_open(
        address: SocketAddr,
        authority: Option<&str>,
        headers: &[(&'static str, &str)],
    ) -> Result<Self, u16> {
        Self::open_at("/ws", address, authority, headers)
    }

    /// The second connection of a page, which carries its view.
    #[track_caller]
    pub fn open_view(hello: &Value, address: SocketAddr, authority: Option<&str>) -> Self {
        let mut view = Self::open_at("/ws/view", address, authority, &[]).unwrap_or_else(|error| panic!("{error}"));
        view.say(&json!({"type": "view", "of": hello["view"]}));
        view
    }

    fn open_at(
        path: &str,
        address: SocketAddr,
        authority: Option<&str>,
        headers: &[(&'static str, &str)],
    ) -> Result<Self, u16> {
        let mut request: Request =
            format!("ws://{}{path}", host(address, authority)).into_client_request().expect("a request");
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse().expect("a header"));
        }
        let stream = tcp(address);
        let own = stream.try_clone().expect("a socket can be shared");
        match tungstenite::client(request, connect_by(stream, address, authority)) {
            Ok((socket, _)) => {
                Ok(Self { socket, stream: own, pieces: Vec::new(), next_id: 1, seen_ms: 0.0, heard: Vec::new() })
            }
            Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(answer))) => {
                Err(answer.status().as_u16())
            }
            Err(error) => panic!("no answer to a WebSocket: {error}"),
        }
    }

    /// Says something. The connection may have ended.
    pub fn say(&mut self, message: &Value) {
        let _ = self.socket.send(Message::text(message.to_string()));
    }

    /// Says something that need not make sense.
    pub fn say_raw(&mut self, message: Message) {
        let _ = self.socket.send(message);
    }

    /// [`poll`](Self::poll) waits so long for something to come.
    pub fn set_patience(&mut self, patience: Duration) {
        self.stream.set_read_timeout(Some(patience)).expect("a socket has timeouts");
    }

    /// The next thing that comes within the patience.
    pub fn poll(&mut self) -> Polled {
        match self.read() {
            Ok(came) => Polled::Came(came),
            Err(tungstenite::Error::Io(error))
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) =>
            {
                Polled::Nothing
            }
            Err(_) => Polled::Ended,
        }
    }

    /// The next thing that comes; `None`: the connection has ended.
    pub fn next(&mut self) -> Option<Result<Value, Picture>> {
        self.read().ok()
    }

    fn read(&mut self) -> tungstenite::Result<Result<Value, Picture>> {
        loop {
            match self.socket.read()? {
                Message::Text(text) => {
                    let value: Value = serde_json::from_str(&text).expect("texts are JSON");
                    self.heard.push(value.clone());
                    self.seen_ms = value["time_ms"].as_f64().map_or(self.seen_ms, |ms| ms.max(self.seen_ms));
                    return Ok(Ok(value));
                }
                Message::Binary(bytes) => {
                    self.pieces.extend_from_slice(&bytes);
                    if let Some(picture) = whole(&self.pieces) {
                        self.pieces.clear();
                        return Ok(Err(picture));
                    }
                }
                Message::Close(_) => return Err(tungstenite::Error::ConnectionClosed),
                _ => {}
            }
        }
    }

    /// Waits for a text that fits, and passes over all else.
    #[track_caller]
    pub fn hear(&mut self, what: &str, fits: impl Fn(&Value) -> bool) -> Value {
        let begun = Instant::now();
        while begun.elapsed() < HANGS_AFTER {
            match self.next() {
                Some(Ok(value)) if fits(&value) => return value,
                Some(_) => {}
                None => panic!("{what}: the connection has ended; heard: {:?}", self.heard),
            }
        }
        panic!("{what}: never heard among {} messages", self.heard.len());
    }

    /// As [`hear`](Self::hear), if it has not come already.
    #[track_caller]
    pub fn have_heard(&mut self, what: &str, fits: impl Fn(&Value) -> bool) -> Value {
        let known = self.heard.iter().find(|value| fits(value)).cloned();
        known.unwrap_or_else(|| self.hear(what, fits))
    }

    /// Waits for a text of this type.
    #[track_caller]
    pub fn hear_type(&mut self, name: &str) -> Value {
        self.hear(name, |value| value["type"] == name)
    }

    /// Waits for an image, and passes over all else.
    #[track_caller]
    pub fn see(&mut self) -> Picture {
        let begun = Instant::now();
        while begun.elapsed() < HANGS_AFTER {
            match self.next() {
                Some(Err(picture)) => return picture,
                Some(Ok(_)) => {}
                None => panic!("no image: the connection has ended"),
            }
        }
        panic!("no image came");
    }

    /// Asks, and waits for the answer.
    #[track_caller]
    pub fn ask(&mut self, mut question: Value) -> Result<Value, String> {
        let id = self.next_id;
        self.next_id += 1;
        question["id"] = id.into();
        self.say(&question);
        let reply = self.hear("an answer", |value| value["type"] == "reply" && value["id"] == id);
        if reply["ok"] == true {
            Ok(reply["value"].clone())
        } else {
            Err(reply["error"].as_str().unwrap_or_default().into())
        }
    }

    /// Drives for a moment, and gives what is said to it.
    #[track_caller]
    pub fn drive(&mut self, seq: u64, steering_rad: f64, speed_m_s: f64) -> Value {
        let seen_ms = self.seen_ms;
        self.say(&json!({"type": "drive", "seq": seq, "steering_rad": steering_rad, "speed_m_s": speed_m_s, "seen_ms": seen_ms}));
        self.hear("an answer", |value| value["type"] == "drive_ack" && value["seq"] == seq)
    }

    /// Asks to see these keys, as often as they come.
    pub fn subscribe(&mut self, keys: &[&str]) {
        let keys: Vec<Value> =
            keys.iter().map(|key| json!({"key": key, "max_hz": 100, "width": 320, "quality": 60})).collect();
        self.say(&json!({"type": "subscribe", "keys": keys}));
    }

    /// Acknowledges an image.
    pub fn ack(&mut self, picture: &Picture) {
        self.say(&json!({"type": "ack", "key": picture.header["key"], "seq": picture.header["seq"]}));
    }

    /// Reads until the connection has ended.
    #[track_caller]
    pub fn until_it_ends(&mut self) {
        let begun = Instant::now();
        while self.next().is_some() {
            assert!(begun.elapsed() < HANGS_AFTER, "the connection never ends");
        }
    }
}
