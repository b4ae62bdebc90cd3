//! Connections: how many there are, how long they may take over what, and who leaves when there are too many.
//!
//! A connection that sends nothing costs its sender nothing, so it must cost us little: where all places are taken, the one that has been
//! idle or half way through a header longest gives its place to a newcomer. Those with a request under way keep theirs.

use super::problem::Refused;
use crate::metrics::Metrics;
use axum::Router;
use axum::body::{Body, Bytes};
use axum::http::Request;
use http_body::{Body as HttpBody, Frame, SizeHint};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{sleep, timeout};
use tokio_io_timeout::TimeoutStream;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

/// A header that takes longer is not waited for; nor is the next request of a connection.
const HEADER_TIME: Duration = Duration::from_secs(15);
/// A reader that takes nothing for so long is not written to any more.
const WRITE_TIME: Duration = Duration::from_secs(30);
/// Bytes of a request's line and headers.
const MAX_HEADER_BYTES: usize = 64 << 10;

/// Serves until `shutdown`; then requests under way are finished. Trouble with one connection is that connection's.
pub async fn serve(listener: TcpListener, router: Router, most: usize, metrics: Arc<Metrics>, shutdown: CancellationToken) {
    metrics.requests.connections_limit.set(most as i64);
    let (places, graceful) = (Places::new(most, metrics.clone()), GracefulShutdown::new());
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = shutdown.cancelled() => break,
        };
        match accepted {
            Ok((stream, _)) => match places.enter() {
                Some(place) => drop(tokio::spawn(connection(stream, router.clone(), place, graceful.watcher()))),
                None => drop(tokio::spawn(turn_away(stream, metrics.clone()))),
            },
            // Out of file descriptors, say: those in use come back.
            Err(error) => {
                tracing::warn!(%error, "a connection could not be accepted");
                sleep(Duration::from_millis(100)).await;
            }
        }
    }
    drop(listener);
    graceful.shutdown().await;
}

async fn connection(stream: TcpStream, router: Router, place: Place, watcher: hyper_util::server::graceful::Watcher) {
    // A small answer does not wait for the acknowledgement of the one before. One that can not be told is sent all the same.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIME));
    let (close, place) = (place.close.clone(), Arc::new(place));
    let service = service_fn(move |request: Request<hyper::body::Incoming>| {
        let (router, busy) = (router.clone(), Busy::of(&place));
        async move {
            let response = router.oneshot(request.map(Body::new)).await;
            response.map(|response| response.map(|body| Held { body, _busy: busy }))
        }
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(MAX_HEADER_BYTES)
        .serve_connection(TokioIo::new(Box::pin(stream)), service);
    tokio::select! {
        served = watcher.watch(served) => if let Err(error) = served {
            tracing::debug!(%error, "a connection ended early");
        },
        () = close.cancelled() => tracing::debug!("an idle connection gave its place to a newcomer"),
    }
}

/// Says that there is no room, for those who listen.
async fn turn_away(mut stream: TcpStream, metrics: Arc<Metrics>) {
    metrics.requests.connections_refused.inc();
    let body = Refused::no_connection().body();
    let response = format!(
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\nretry-after: 1\r\nconnection: close\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    );
    let _ = timeout(Duration::from_secs(1), stream.write_all(response.as_bytes())).await;
}

/// Who is connected.
#[derive(Clone)]
struct Places {
    most: usize,
    /// By order of arrival.
    taken: Arc<Mutex<BTreeMap<u64, Taken>>>,
    next: Arc<AtomicU64>,
    metrics: Arc<Metrics>,
}

struct Taken {
    /// Requests under way, their answers included.
    busy: usize,
    close: CancellationToken,
}

/// A connection's place; free again when this is dropped.
struct Place {
    places: Places,
    number: u64,
    close: CancellationToken,
}

impl Places {
    fn new(most: usize, metrics: Arc<Metrics>) -> Self {
        Self { most, taken: Arc::default(), next: Arc::default(), metrics }
    }

    fn taken(&self) -> MutexGuard<'_, BTreeMap<u64, Taken>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place, if need be that of the connection that has been idle longest; `None` where all have work under way.
    fn enter(&self) -> Option<Place> {
        let mut taken = self.taken();
        if taken.len() >= self.most {
            let idle = taken.iter().find(|(_, place)| place.busy == 0).map(|(number, _)| *number)?;
            taken.remove(&idle)?.close.cancel();
        }
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let close = CancellationToken::new();
        taken.insert(number, Taken { busy: 0, close: close.clone() });
        self.metrics.requests.connections.set(taken.len() as i64);
        drop(taken);
        Some(Place { places: self.clone(), number, close })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken();
        taken.remove(&self.number);
        self.places.metrics.requests.connections.set(taken.len() as i64);
    }
}

/// A request under way.
struct Busy(Arc<Place>);

impl Busy {
    fn of(place: &Arc<Place>) -> Self {
        if let Some(taken) = place.places.taken().get_mut(&place.number) {
            taken.busy += 1;
        }
        Self(place.clone())
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        if let Some(taken) = self.0.places.taken().get_mut(&self.0.number) {
            taken.busy -= 1;
        }
    }
}

/// A response's body, under way until it is sent.
struct Held {
    body: Body,
    _busy: Busy,
}

impl HttpBody for Held {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
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
    fn the_longest_idle_leaves_and_who_works_stays() {
        let places = Places::new(2, Arc::default());
        let (first, second) = (Arc::new(places.enter().unwrap()), Arc::new(places.enter().unwrap()));
        let working = Busy::of(&first);
        let third = places.enter().unwrap();
        assert!(second.close.is_cancelled() && !first.close.is_cancelled());
        let third = Arc::new(third);
        let also = Busy::of(&third);
        assert!(places.enter().is_none(), "all have work under way");
        drop((working, also));
        assert!(places.enter().is_some() && first.close.is_cancelled());
        drop(second);
        assert_eq!(places.taken().len(), 1, "the last newcomer has left, the third is there");
    }
}
