//! Limits how slowly a request body may arrive, on every route.
//!
//! A body that stops, or arrives more slowly than its route allows, is abandoned: the request is
//! answered with 408 and its connection is closed. Only the time for which the server waits for the
//! client counts, so that a slow disk is not taken for a slow client.

use super::connections::BodyProgress;
use super::problem::ProblemResponse;
use axum::body::{Body, Bytes};
use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use http_body::{Body as HttpBody, Frame, SizeHint};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::{Instant, Sleep, sleep_until};
use uniground_service::error::Error;

/// Routes whose bodies have any size and are processed while they arrive.
const STREAMED: [&str; 4] =
    ["/v1/scenes", "/v1/scenes/{scene_id}/frames", "/v1/uploads", "/v1/uploads/{upload_id}"];
/// The route that streams every body but JSON.
const STREAMED_UNLESS_JSON: &str = "/v1/batches";

/// The slowest body that is accepted.
#[derive(Debug, Clone, Copy)]
struct MinimumRate {
    /// Maximum pause between two chunks.
    silence: Duration,
    /// Longest time for a body of any size; for a streamed one, the time after which its rate
    /// counts.
    grace: Duration,
    /// Minimum average rate of a body that takes longer than `grace`. `None`: no body may.
    bytes_per_s: Option<u64>,
    /// Maximum time for the whole body.
    total: Duration,
}

/// The rule for bodies that are read as a whole, a megabyte at most.
const WHOLE_BODY_RATE: MinimumRate = MinimumRate {
    silence: Duration::from_secs(20),
    grace: Duration::from_secs(20),
    bytes_per_s: None,
    total: Duration::from_secs(20),
};
/// The rule for uploads and lists of questions. An upload that takes longer than a day has to be
/// sent in parts (`/v1/uploads`), each a body of its own.
const STREAM_RATE: MinimumRate = MinimumRate {
    silence: Duration::from_secs(20),
    grace: Duration::from_secs(30),
    bytes_per_s: Some(1 << 10),
    total: Duration::from_hours(24),
};

impl MinimumRate {
    /// Returns the rule for a route and a content type.
    fn for_route(route: &str, content_type: &str) -> Self {
        // Not "application/jsonl", which is streamed.
        let is_json = || {
            content_type
                .split(';')
                .next()
                .unwrap_or_default()
                .trim()
                .eq_ignore_ascii_case("application/json")
        };
        match STREAMED.contains(&route) || (route == STREAMED_UNLESS_JSON && !is_json()) {
            true => STREAM_RATE,
            false => WHOLE_BODY_RATE,
        }
    }

    /// Returns how much longer the server waits for the next piece, after it has waited `waited`
    /// for the `received` bytes so far.
    fn time_left(&self, received: u64, waited: Duration) -> Duration {
        let earned =
            self.bytes_per_s.map_or(Duration::ZERO, |rate| Duration::from_secs(received / rate));
        let most = earned.max(self.grace).min(self.total);
        most.saturating_sub(waited).min(self.silence)
    }

    fn timeout_problem(&self) -> ProblemResponse {
        if let Some(bytes_per_s) = self.bytes_per_s {
            Error::UploadTooSlow { bytes_per_s, silence_s: self.silence.as_secs() }.into()
        } else {
            let detail = format!("a JSON body must arrive within {} s", self.total.as_secs());
            ProblemResponse::new(StatusCode::REQUEST_TIMEOUT, "body_too_slow", detail)
        }
    }
}

/// Abandons bodies that arrive too slowly.
pub async fn limit(request: Request, next: Next) -> Response {
    let route = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
    let content_type =
        request.headers().get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let rate = MinimumRate::for_route(route, content_type.unwrap_or_default());
    limit_to(rate, request, next).await
}

async fn limit_to(rate: MinimumRate, request: Request, next: Next) -> Response {
    if request.body().is_end_stream() {
        return next.run(request).await;
    }
    let is_abandoned = Arc::new(AtomicBool::new(false));
    let progress = request.extensions().get::<BodyProgress>().cloned().unwrap_or_default();
    let limited = |body| Body::new(LimitedBody::new(body, rate, progress, is_abandoned.clone()));
    let response = next.run(request.map(limited)).await;
    match is_abandoned.load(Ordering::Relaxed) {
        true => too_slow(&rate, response),
        false => response,
    }
}

/// Returns the response to a body that was abandoned, in place of the error that the handler made
/// of it. Its headers stay.
fn too_slow(rate: &MinimumRate, made: Response) -> Response {
    let mut response = match made.status() {
        // The handler had what it needed.
        status if status.is_success() => made,
        _ => {
            let mut refused = rate.timeout_problem().into_response();
            for (name, value) in made.headers() {
                if !refused.headers().contains_key(name) && *name != header::CONTENT_LENGTH {
                    refused.headers_mut().append(name, value.clone());
                }
            }
            refused
        }
    };
    response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    response
}

/// A body that ends in an error when it arrives too slowly.
struct LimitedBody {
    body: Body,
    rate: MinimumRate,
    progress: BodyProgress,
    timer: Pin<Box<Sleep>>,
    is_abandoned: Arc<AtomicBool>,
}

#[derive(Debug, thiserror::Error)]
#[error("the body arrives too slowly")]
struct TooSlow;

impl LimitedBody {
    fn new(
        body: Body,
        rate: MinimumRate,
        progress: BodyProgress,
        is_abandoned: Arc<AtomicBool>,
    ) -> Self {
        progress.begin();
        Self { body, rate, progress, timer: Box::pin(sleep_until(Instant::now())), is_abandoned }
    }
}

impl HttpBody for LimitedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = &mut *self;
        if this.is_abandoned.load(Ordering::Relaxed) {
            return Poll::Ready(None);
        }
        if let Poll::Ready(frame) = Pin::new(&mut this.body).poll_frame(context) {
            let bytes = frame
                .as_ref()
                .and_then(|frame| frame.as_ref().ok()?.data_ref())
                .map_or(0, Bytes::len);
            this.progress.received(bytes as u64);
            return Poll::Ready(frame);
        }
        if let Some((received, waited)) = this.progress.wait() {
            this.timer.as_mut().reset(Instant::now() + this.rate.time_left(received, waited));
        }
        match this.timer.as_mut().poll(context) {
            Poll::Ready(()) => {
                this.is_abandoned.store(true, Ordering::Relaxed);
                Poll::Ready(Some(Err(axum::Error::new(TooSlow))))
            }
            Poll::Pending => Poll::Pending,
        }
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// The server no longer waits for the client.
impl Drop for LimitedBody {
    fn drop(&mut self) {
        self.progress.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::Router;
    use axum::body::to_bytes;
    use axum::middleware::from_fn;
    use axum::routing::post;
    use futures::{StreamExt, stream};
    use tower::ServiceExt;
    use uniground_types::problem::Problem;

    const FAST_RATE: MinimumRate = MinimumRate {
        silence: Duration::from_millis(200),
        grace: Duration::from_millis(400),
        bytes_per_s: None,
        total: Duration::from_millis(400),
    };

    /// Returns the response of a handler that reads a body of so many pieces with this delay.
    async fn answer(rate: MinimumRate, pieces: usize, apart: Duration) -> Response {
        let body = stream::iter(0..pieces).then(move |_| async move {
            tokio::time::sleep(apart).await;
            Ok::<_, std::io::Error>("x")
        });
        let read = async |body: Body| match to_bytes(body, 1 << 20).await {
            Ok(bytes) => bytes.len().to_string().into_response(),
            Err(_) => {
                (StatusCode::PAYLOAD_TOO_LARGE, [("location", "/here")], "cut off").into_response()
            }
        };
        let router = Router::new()
            .route("/", post(read))
            .layer(from_fn(move |request, next| limit_to(rate, request, next)));
        let request = Request::post("/").body(Body::from_stream(body)).unwrap();
        router.oneshot(request).await.unwrap()
    }

    #[tokio::test]
    async fn slow_or_stalled_bodies_get_408_and_close_the_connection() {
        for (what, apart) in
            [("it drips", Duration::from_millis(20)), ("it stops", Duration::from_hours(1))]
        {
            let response = answer(FAST_RATE, usize::MAX, apart).await;
            assert_eq!(response.status(), StatusCode::REQUEST_TIMEOUT, "{what}");
            assert_eq!(response.headers()[header::CONNECTION], "close", "{what}");
            assert_eq!(response.headers()["location"], "/here", "{what}");
            let problem =
                response.extensions().get::<Problem>().map(|problem| problem.code.as_str());
            assert_eq!(problem, Some("body_too_slow"), "{what}");
        }
        let streamed = MinimumRate { bytes_per_s: Some(1 << 10), ..FAST_RATE };
        let response = answer(streamed, usize::MAX, Duration::from_millis(20)).await;
        assert_eq!(response.extensions().get::<Problem>().unwrap().code, "upload_too_slow");
    }

    #[tokio::test]
    async fn a_body_that_arrives_in_time_is_read() {
        let response = answer(FAST_RATE, 5, Duration::from_millis(1)).await;
        assert_eq!(
            (response.status(), response.headers().get(header::CONNECTION)),
            (StatusCode::OK, None)
        );
        assert_eq!(to_bytes(response.into_body(), 10).await.unwrap(), "5");
    }

    #[test]
    fn a_streamed_body_may_take_as_long_as_its_rate_allows() {
        let s = Duration::from_secs;
        for (received, waited, patience) in [
            (0, s(0), s(20)),
            (0, s(25), s(5)),
            (0, s(30), s(0)),
            (1 << 20, s(1000), s(20)),
            (1 << 20, s(1014), s(10)),
            (1 << 20, s(1024), s(0)),
            // Fast enough per second, but above the total limit.
            (1 << 40, s(86_390), s(10)),
            (1 << 40, s(86_400), s(0)),
        ] {
            assert_eq!(
                STREAM_RATE.time_left(received, waited),
                patience,
                "{received} bytes in {waited:?}"
            );
        }
        assert_eq!(WHOLE_BODY_RATE.time_left(1 << 20, s(19)), s(1));
    }

    #[test]
    fn uploads_and_lists_of_questions_are_streamed_and_json_is_not() {
        for (route, content_type, is_streamed) in [
            ("/v1/scenes", "application/zip", true),
            // The content type of an upload does not matter.
            ("/v1/scenes", "application/json", true),
            ("/v1/uploads/{upload_id}", "application/offset+octet-stream", true),
            ("/v1/batches", "application/jsonl", true),
            ("/v1/batches", "application/x-ndjson; charset=utf-8", true),
            ("/v1/batches", "application/json", false),
            ("/v1/batches", "Application/JSON; charset=utf-8", false),
            ("/v1/scenes/import", "application/json", false),
            ("/mcp", "application/json", false),
            ("", "", false),
        ] {
            let rate = MinimumRate::for_route(route, content_type);
            assert_eq!(rate.bytes_per_s.is_some(), is_streamed, "{route} as {content_type}");
        }
    }

    #[test]
    fn streamed_routes_exist() {
        let known = super::super::openapi().paths.paths;
        for route in STREAMED.into_iter().chain([STREAMED_UNLESS_JSON]) {
            assert!(known.contains_key(route), "{route}");
        }
    }
}
