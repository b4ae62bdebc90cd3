//! Limits the number of connections and their durations.
//!
//! If all slots are taken, the connection that has kept the server waiting longest is closed for a
//! new one: one that is idle, that is sending a header, or whose request body arrives slowly.
//! Connections whose request is being processed are kept.

use super::problem::ProblemResponse;
use axum::Router;
use axum::body::{Body, Bytes};
use axum::http::Request;
use http_body::{Body as HttpBody, Frame, SizeHint};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::io::AsyncWriteExt;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{sleep, timeout};
use tokio_io_timeout::TimeoutStream;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;
use uniground_telemetry::metrics::Metrics;

/// Timeout for a request header and for the next request of a connection.
const HEADER_TIME: Duration = Duration::from_secs(15);
/// Timeout for writing to a client that does not read.
const WRITE_TIME: Duration = Duration::from_secs(30);
/// Maximum size of a request's line and headers, bytes.
const MAX_HEADER_BYTES: usize = 64 << 10;

/// Serves until `shutdown`, then finishes running requests. An error of one connection does not
/// affect others.
pub async fn serve(
    listener: TcpListener,
    router: Router,
    most: usize,
    metrics: Arc<Metrics>,
    shutdown: CancellationToken,
) {
    metrics.requests.connections_limit.set(most as i64);
    let (places, graceful) =
        (ConnectionLimiter::new(most, metrics.clone()), GracefulShutdown::new());
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = shutdown.cancelled() => break,
        };
        match accepted {
            Ok((stream, _)) => match places.try_enter() {
                Some(place) => drop(tokio::spawn(handle_connection(
                    stream,
                    router.clone(),
                    place,
                    graceful.watcher(),
                ))),
                None => drop(tokio::spawn(reject_connection(stream, metrics.clone()))),
            },
            // For example, the process is out of file descriptors. Connections that end free some.
            Err(error) => {
                tracing::warn!(%error, "connection could not be accepted");
                sleep(Duration::from_millis(100)).await;
            }
        }
    }
    drop(listener);
    graceful.shutdown().await;
}

async fn handle_connection(
    stream: TcpStream,
    router: Router,
    place: ConnectionSlot,
    watcher: hyper_util::server::graceful::Watcher,
) {
    // Disables Nagle's algorithm, so that small responses are not delayed. An error is ignored.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIME));
    let (close, place) = (place.close.clone(), Arc::new(place));
    let service = service_fn(move |request: Request<hyper::body::Incoming>| {
        let (router, busy, mut request) =
            (router.clone(), ActiveRequest::new(&place), request.map(Body::new));
        request.extensions_mut().insert(place.body.clone());
        async move {
            let response = router.oneshot(request).await;
            response.map(|response| response.map(|body| TrackedBody { body, _busy: busy }))
        }
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(MAX_HEADER_BYTES)
        .serve_connection(TokioIo::new(Box::pin(stream)), service);
    tokio::select! {
        served = watcher.watch(served) => if let Err(error) = served {
            tracing::debug!(%error, "connection closed early");
        },
        () = close.cancelled() => tracing::debug!("connection closed to make room for a new one"),
    }
}

/// Answers a rejected connection with 503.
async fn reject_connection(mut stream: TcpStream, metrics: Arc<Metrics>) {
    metrics.requests.connections_refused.inc();
    let body = ProblemResponse::too_many_connections().body();
    let response = format!(
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\nretry-after: 1\r\nconnection: close\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    );
    let _ = timeout(Duration::from_secs(1), stream.write_all(response.as_bytes())).await;
}

/// Tracks the open connections.
#[derive(Clone)]
struct ConnectionLimiter {
    most: usize,
    /// State of each connection, in the order of arrival.
    taken: Arc<Mutex<BTreeMap<u64, ConnectionState>>>,
    next: Arc<AtomicU64>,
    metrics: Arc<Metrics>,
}

struct ConnectionState {
    /// Number of running requests, including their responses.
    busy: usize,
    /// Time when the last request ended.
    idle_since: Instant,
    body: BodyProgress,
    close: CancellationToken,
}

impl ConnectionState {
    /// Returns how long the client has kept the server waiting; `None` while the server works on
    /// its request.
    fn lag(&self, now: Instant) -> Option<Duration> {
        match self.busy {
            0 => Some(now.saturating_duration_since(self.idle_since)),
            _ => self.body.lag(now),
        }
    }
}

/// A slot of a connection. Freed on drop.
struct ConnectionSlot {
    places: ConnectionLimiter,
    number: u64,
    body: BodyProgress,
    close: CancellationToken,
}

/// A client that sends the body of a request at this rate does not keep the server waiting, bytes
/// per second.
const EXPECTED_BYTES_PER_S: u64 = 16 << 10;

/// The progress of the body of a connection's current request.
#[derive(Debug, Clone, Default)]
pub struct BodyProgress(Arc<Mutex<BodyArrival>>);

#[derive(Debug, Default)]
struct BodyArrival {
    bytes: u64,
    /// Time for which the server has waited for these bytes.
    waited: Duration,
    /// When it began to wait for the next ones, where it does.
    waiting_since: Option<Instant>,
}

impl BodyProgress {
    fn lock_arrival(&self) -> MutexGuard<'_, BodyArrival> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts over with the body of another request.
    pub fn begin(&self) {
        *self.lock_arrival() = BodyArrival::default();
    }

    /// Records that the server waits for the client from now on. Returns the bytes received so far
    /// and the time spent waiting for them; `None` if it was waiting already.
    pub fn wait(&self) -> Option<(u64, Duration)> {
        let mut arrived = self.lock_arrival();
        if arrived.waiting_since.is_some() {
            return None;
        }
        arrived.waiting_since = Some(Instant::now());
        Some((arrived.bytes, arrived.waited))
    }

    /// Records that more bytes were received.
    pub fn received(&self, bytes: u64) {
        let mut arrived = self.lock_arrival();
        arrived.bytes += bytes;
        if let Some(since) = arrived.waiting_since.take() {
            arrived.waited += since.elapsed();
        }
    }

    /// Records that the server waits for no more of this body.
    pub fn end(&self) {
        self.lock_arrival().waiting_since = None;
    }

    /// Returns how far the client lags behind [`EXPECTED_BYTES_PER_S`]. `None` if it does not lag,
    /// or if the server does not wait for it.
    fn lag(&self, now: Instant) -> Option<Duration> {
        let arrived = self.lock_arrival();
        let waited = arrived.waited + now.saturating_duration_since(arrived.waiting_since?);
        waited
            .checked_sub(Duration::from_millis(
                arrived.bytes.saturating_mul(1000) / EXPECTED_BYTES_PER_S,
            ))
            .filter(|lag| !lag.is_zero())
    }
}

impl ConnectionLimiter {
    fn new(most: usize, metrics: Arc<Metrics>) -> Self {
        Self { most, taken: Arc::default(), next: Arc::default(), metrics }
    }

    fn lock_connections(&self) -> MutexGuard<'_, BTreeMap<u64, ConnectionState>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a slot. If all are taken, closes the connection that has kept the server waiting
    /// longest. Returns `None` if all connections have running requests.
    fn try_enter(&self) -> Option<ConnectionSlot> {
        let (mut taken, now) = (self.lock_connections(), Instant::now());
        if taken.len() >= self.most {
            let slowest = taken
                .iter()
                .filter_map(|(number, place)| Some((place.lag(now)?, Reverse(*number))))
                .max();
            let (_, Reverse(number)) = slowest?;
            taken.remove(&number)?.close.cancel();
        }
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let (body, close) = (BodyProgress::default(), CancellationToken::new());
        taken.insert(
            number,
            ConnectionState { busy: 0, idle_since: now, body: body.clone(), close: close.clone() },
        );
        self.metrics.requests.connections.set(taken.len() as i64);
        drop(taken);
        Some(ConnectionSlot { places: self.clone(), number, body, close })
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        let mut taken = self.places.lock_connections();
        taken.remove(&self.number);
        self.places.metrics.requests.connections.set(taken.len() as i64);
    }
}

/// A running request.
struct ActiveRequest(Arc<ConnectionSlot>);

impl ActiveRequest {
    fn new(place: &Arc<ConnectionSlot>) -> Self {
        if let Some(taken) = place.places.lock_connections().get_mut(&place.number) {
            taken.busy += 1;
        }
        Self(place.clone())
    }
}

impl Drop for ActiveRequest {
    fn drop(&mut self) {
        if let Some(taken) = self.0.places.lock_connections().get_mut(&self.0.number) {
            taken.busy -= 1;
            taken.idle_since = Instant::now();
        }
    }
}

/// A response body that counts as running until it is sent.
struct TrackedBody {
    body: Body,
    _busy: ActiveRequest,
}

impl HttpBody for TrackedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_idle_connection_is_closed_and_active_ones_stay() {
        let places = ConnectionLimiter::new(2, Arc::default());
        let (first, second) =
            (Arc::new(places.try_enter().unwrap()), Arc::new(places.try_enter().unwrap()));
        let working = ActiveRequest::new(&first);
        let third = places.try_enter().unwrap();
        assert!(second.close.is_cancelled() && !first.close.is_cancelled());
        let third = Arc::new(third);
        let also = ActiveRequest::new(&third);
        assert!(places.try_enter().is_none(), "all have work under way");
        drop((working, also));
        assert!(places.try_enter().is_some() && first.close.is_cancelled());
        drop(second);
        assert_eq!(
            places.lock_connections().len(),
            1,
            "the last newcomer has left, the third is there"
        );
    }

    #[test]
    fn slow_senders_are_closed_before_clients_that_wait_for_an_answer() {
        let places = ConnectionLimiter::new(3, Arc::default());
        let [answered, quick, slow] = [(); 3].map(|()| Arc::new(places.try_enter().unwrap()));
        let _busy = [&answered, &quick, &slow].map(ActiveRequest::new);
        for (place, bytes) in [(&quick, 100 << 20), (&slow, 1)] {
            place.body.begin();
            place.body.received(bytes);
            assert_eq!(place.body.wait().map(|(bytes, _)| bytes), Some(bytes));
            assert_eq!(place.body.wait(), None, "it is waited for already");
        }
        let is_closed = |place: &ConnectionSlot| place.close.is_cancelled();
        std::thread::sleep(Duration::from_millis(2));
        let newcomer = Arc::new(places.try_enter().unwrap());
        assert!(is_closed(&slow) && !is_closed(&quick) && !is_closed(&answered));
        let _busy = ActiveRequest::new(&newcomer);
        assert!(places.try_enter().is_none(), "nobody else keeps the server waiting");
    }

    #[test]
    fn lag_is_measured_against_the_expected_rate() {
        let (progress, s, start) = (BodyProgress::default(), Duration::from_secs, Instant::now());
        *progress.lock_arrival() = BodyArrival {
            bytes: 10 * EXPECTED_BYTES_PER_S,
            waited: s(8),
            waiting_since: Some(start),
        };
        let after = |seconds| progress.lag(start + s(seconds));
        assert_eq!((after(1), after(5)), (None, Some(s(3))));
        progress.end();
        assert_eq!(after(5), None, "it is not waited for");
    }
}
