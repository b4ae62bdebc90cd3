//! A scripted OpenAI-compatible server on loopback that plays the model.

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::post;
use futures::stream;
use serde_json::{Value, json};
use std::convert::Infallible;
use std::future::pending;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::time::sleep;
use tokio_util::sync::{CancellationToken, DropGuard};

/// The authorization and the body of a request.
pub type Asked = (Option<String>, Value);

/// A scripted response.
#[derive(Debug, Clone)]
pub enum Scripted {
    Json(u16, Value),
    /// With a header `Retry-After`.
    After(u16, &'static str),
    Text(String),
    /// A redirect that keeps method and body.
    Redirect(String),
    /// A body that never ends and arrives fast.
    Flood,
    /// A body whose next byte never arrives.
    Stall,
    /// No response at all, not even a status.
    Silent,
    /// Another response after a delay.
    Slowly(Duration, Box<Self>),
}

/// The next responses of the model and the requests it received.
#[derive(Clone, Default)]
pub struct Script {
    answers: Arc<Mutex<Vec<Scripted>>>,
    pub asked: Arc<Mutex<Vec<Asked>>>,
    /// Cancelled when a caller disconnects from a response that never ends or never begins.
    pub left: CancellationToken,
}

impl Script {
    /// Serves these responses in order and then repeats the last one. Returns the base URL.
    pub async fn serve(&self, answers: Vec<Scripted>) -> String {
        self.serve_at("127.0.0.1:0", answers).await
    }

    /// The same at an address.
    pub async fn serve_at(&self, address: &str, answers: Vec<Scripted>) -> String {
        self.next(answers);
        let listener = tokio::net::TcpListener::bind(address).await.unwrap();
        let address = listener.local_addr().unwrap();
        let router = axum::Router::new()
            .route("/v1/chat/completions", post(complete))
            .layer(axum::extract::DefaultBodyLimit::disable())
            .with_state(self.clone());
        tokio::spawn(async move { axum::serve(listener, router).await });
        format!("http://{address}/v1")
    }

    /// Replaces the responses from now on.
    pub fn next(&self, answers: Vec<Scripted>) {
        *self.answers.lock().unwrap() = answers;
    }

    pub fn calls(&self) -> usize {
        self.asked.lock().unwrap().len()
    }

    /// Returns the bodies of all requests since the last call.
    pub fn take(&self) -> Vec<Value> {
        self.asked.lock().unwrap().drain(..).map(|(_, body)| body).collect()
    }
}

async fn complete(
    State(script): State<Script>,
    headers: HeaderMap,
    Json(body): Json<Value>,
) -> Response {
    let key = headers.get("authorization").map(|v| v.to_str().unwrap().to_owned());
    script.asked.lock().unwrap().push((key, body));
    let answer = {
        let mut answers = script.answers.lock().unwrap();
        if answers.len() > 1 { answers.remove(0) } else { answers[0].clone() }
    };
    let answer = match answer {
        Scripted::Slowly(wait, answer) => {
            sleep(wait).await;
            *answer
        }
        at_once => at_once,
    };
    match answer {
        Scripted::Json(status, answer) => {
            (StatusCode::from_u16(status).unwrap(), Json(answer)).into_response()
        }
        Scripted::After(status, wait) => {
            (StatusCode::from_u16(status).unwrap(), [("retry-after", wait)], "later")
                .into_response()
        }
        Scripted::Slowly(..) => unreachable!("delayed responses must not be nested"),
        Scripted::Text(text) => text.into_response(),
        Scripted::Redirect(address) => {
            (StatusCode::PERMANENT_REDIRECT, [("location", address)]).into_response()
        }
        Scripted::Flood => {
            let chunk = vec![b' '; 1 << 16];
            Body::from_stream(stream::repeat_with(move || Ok::<_, Infallible>(chunk.clone())))
                .into_response()
        }
        Scripted::Silent => {
            let _guard = script.left.clone().drop_guard();
            pending().await
        }
        Scripted::Stall => {
            let guard = script.left.clone().drop_guard();
            let never = stream::unfold(guard, |guard: DropGuard| async {
                sleep(Duration::from_hours(1)).await;
                Some((Ok::<_, Infallible>(Vec::new()), guard))
            });
            let first = stream::once(async { Ok(b"{".to_vec()) });
            Body::from_stream(futures::StreamExt::chain(first, never)).into_response()
        }
    }
}

/// Returns a completion with this text.
pub fn says(text: &str) -> Scripted {
    let usage = json!({"prompt_tokens": 700, "completion_tokens": 40});
    Scripted::Json(
        200,
        json!({"choices": [{"message": {"role": "assistant", "content": text}}], "usage": usage}),
    )
}

pub fn fails(status: u16, message: &str) -> Scripted {
    Scripted::Json(status, json!({"error": {"message": message}}))
}
