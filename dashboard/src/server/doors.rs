//! Connections as they come in: plain HTTP and TLS on the same port, told apart by their first byte. Little is kept in the sockets, so
//! that what is sent is new when it arrives.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, PoisonError, RwLock};
use std::task::{Context, Poll};
use std::time::Duration;

use carril_runtime::transport::zenoh::Identity;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

/// Connections at a time, of browsers that load the page and of viewers.
const MOST_CONNECTIONS: usize = 512;
/// Whoever connects says something within this time.
const FIRST_WORD: Duration = Duration::from_secs(5);
/// What the kernel keeps of what was sent, B (it takes twice as much).
const SEND_BUFFER: u32 = 64 << 10;
/// What it takes beyond what is on its way already, B.
const NOT_SENT: u32 = 16 << 10;
/// The first byte of a TLS handshake.
const TLS_HANDSHAKE: u8 = 0x16;

/// The other end of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peer {
    /// From where.
    pub address: SocketAddr,
    /// Over TLS.
    pub encrypted: bool,
}

impl Peer {
    /// Whether it is on this machine.
    pub fn is_here(&self) -> bool {
        self.address.ip().to_canonical().is_loopback()
    }
}

/// What a certificate is made of cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum CertificateError {
    /// As text.
    #[error("the certificate cannot be read: {0}")]
    Pem(#[from] rustls::pki_types::pem::Error),
    /// As a certificate.
    #[error("the certificate cannot be used: {0}")]
    Tls(#[from] rustls::Error),
}

/// The certificate that is shown now.
pub type Shown = Arc<RwLock<Option<TlsAcceptor>>>;

/// A certificate, ready to be shown.
pub fn acceptor(identity: &Identity) -> Result<TlsAcceptor, CertificateError> {
    let chain = [&identity.certificate, &identity.authority];
    let chain = chain.into_iter().map(|pem| CertificateDer::from_pem_slice(pem.as_bytes()));
    let chain = chain.collect::<Result<Vec<_>, _>>()?;
    let key = PrivateKeyDer::from_pem_slice(identity.key.as_bytes())?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    let mut config = config.with_no_client_auth().with_single_cert(chain, key)?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// Where connections come out.
pub struct Doors {
    ready: mpsc::Receiver<(Connection, Peer)>,
    local: SocketAddr,
}

impl Doors {
    /// Begins to listen. Ends with the runtime.
    pub fn open(listen: SocketAddr, shown: Shown) -> io::Result<Self> {
        let socket = if listen.is_ipv6() { TcpSocket::new_v6()? } else { TcpSocket::new_v4()? };
        socket.set_reuseaddr(true)?;
        // Those that are accepted inherit it.
        socket.set_send_buffer_size(SEND_BUFFER)?;
        socket.bind(listen)?;
        let listener = socket.listen(128)?;
        let local = listener.local_addr()?;
        let (out, ready) = mpsc::channel(16);
        tokio::spawn(accept(listener, shown, out));
        Ok(Self { ready, local })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.local
    }

    /// The next one who has said something. `None`: nobody listens any more.
    pub async fn next(&mut self) -> Option<(Connection, Peer)> {
        self.ready.recv().await
    }
}

async fn accept(listener: TcpListener, shown: Shown, out: mpsc::Sender<(Connection, Peer)>) {
    let places = Arc::new(Semaphore::new(MOST_CONNECTIONS));
    while let Ok(place) = Arc::clone(&places).acquire_owned().await {
        let (stream, address) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                // Out of file descriptors, most likely: some come back.
                tracing::debug!("accepting a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let (shown, out) = (Arc::clone(&shown), out.clone());
        tokio::spawn(async move {
            match tokio::time::timeout(FIRST_WORD, greet(stream, &shown)).await {
                Ok(Ok(stream)) => {
                    let peer = Peer { address, encrypted: matches!(stream, Stream::Tls(_)) };
                    // Nobody takes it: the server ends.
                    let _ = out.send((Connection { stream, _place: place }, peer)).await;
                }
                Ok(Err(error)) => tracing::debug!("{address}: {error}"),
                Err(_) => tracing::debug!("{address}: said nothing"),
            }
        });
    }
}

async fn greet(stream: TcpStream, shown: &Shown) -> io::Result<Stream> {
    stream.set_nodelay(true)?;
    if let Err(error) = socket2::SockRef::from(&stream).set_tcp_notsent_lowat(NOT_SENT) {
        tracing::debug!("TCP_NOTSENT_LOWAT: {error}");
    }
    let mut first = [0];
    if stream.peek(&mut first).await? == 0 {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    if first[0] != TLS_HANDSHAKE {
        return Ok(Stream::Plain(stream));
    }
    let acceptor = shown.read().unwrap_or_else(PoisonError::into_inner).clone();
    let acceptor = acceptor.ok_or_else(|| io::Error::other("TLS, and there is no certificate to show"))?;
    Ok(Stream::Tls(Box::new(acceptor.accept(stream).await?)))
}

/// A connection. It has its place until it is dropped.
pub struct Connection {
    stream: Stream,
    _place: OwnedSemaphorePermit,
}

enum Stream {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

trait Duplex: AsyncRead + AsyncWrite {}
impl<T: AsyncRead + AsyncWrite> Duplex for T {}

impl Connection {
    fn pinned(self: Pin<&mut Self>) -> Pin<&mut (dyn Duplex + Unpin)> {
        match &mut self.get_mut().stream {
            Stream::Plain(stream) => Pin::new(stream),
            Stream::Tls(stream) => Pin::new(stream.as_mut()),
        }
    }
}

impl AsyncRead for Connection {
    fn poll_read(self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.pinned().poll_read(context, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.pinned().poll_write(context, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.pinned().poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.pinned().poll_shutdown(context)
    }
}
