//! Parses responses: a value or an error.

use reqwest::{RequestBuilder, Response, StatusCode};
use serde::de::DeserializeOwned;
use uniground_types::problem::{FieldError, Problem};

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The error messages describe the variants.
pub enum ClientError {
    /// The server rejected the request, with a reason.
    #[error("{} ({}){}", .0.detail, .0.code, other_fields(.0))]
    Problem(Box<Problem>),
    #[error("the server answered {status} without a problem document: {body}")]
    Unexpected { status: StatusCode, body: String },
    #[error("the server could not be reached or closed the connection")]
    Transport(#[from] reqwest::Error),
    #[error("the server's response could not be read")]
    Undecodable(#[from] serde_json::Error),
    #[error("{0} is not a server address")]
    BadAddress(String),
}

/// Returns the invalid fields that the detail does not name.
fn other_fields(problem: &Problem) -> String {
    let unnamed = |field: &&FieldError| !problem.detail.contains(&field.detail);
    problem.errors.iter().filter(unnamed).map(|field| format!("; {field}")).collect()
}

pub(crate) async fn json<T: DeserializeOwned>(request: RequestBuilder) -> Result<T, ClientError> {
    let body = checked(request.send().await?).await?.bytes().await?;
    Ok(serde_json::from_slice(&body)?)
}

pub(crate) async fn checked(response: Response) -> Result<Response, ClientError> {
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let retry_after_s =
        response.headers().get("retry-after").and_then(|v| v.to_str().ok()?.parse().ok());
    let body = response.text().await?;
    Err(match serde_json::from_str::<Problem>(&body) {
        Ok(problem) => ClientError::Problem(Box::new(Problem { retry_after_s, ..problem })),
        Err(_) => ClientError::Unexpected { status, body },
    })
}
