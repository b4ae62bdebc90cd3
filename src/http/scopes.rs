//! Required scopes of the routes, read from the OpenAPI description, so that both always agree.

use axum::extract::{MatchedPath, Request};
use axum::http::Method;
use serde_json::Value;
use std::collections::HashMap;
use uniground_types::keys::Scope;
use utoipa::openapi::OpenApi;

/// Scopes by route and method. `None` means that no key is required.
#[derive(Debug)]
pub struct Scopes(HashMap<(String, Method), Option<Scope>>);

impl Scopes {
    /// Reads the field `security` of every operation: `[{"key": ["write"]}, {}]`.
    #[must_use]
    pub fn from_description(description: &OpenApi) -> Self {
        let description = serde_json::to_value(description).unwrap_or_default();
        let mut scopes = HashMap::new();
        for (path, operations) in description["paths"].as_object().into_iter().flatten() {
            for (method, operation) in operations.as_object().into_iter().flatten() {
                let Ok(method) = method.to_ascii_uppercase().parse::<Method>() else { continue };
                scopes.insert((path.clone(), method), read_scope(operation));
            }
        }
        Self(scopes)
    }

    /// Returns the scope that a request's route requires, or `None` if it requires no key. Routes
    /// without a description require admin.
    #[must_use]
    pub fn required_scope(&self, request: &Request) -> Option<Scope> {
        let method = if request.method() == Method::HEAD { &Method::GET } else { request.method() };
        let route = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
        self.0.get(&(route.to_owned(), method.clone())).copied().unwrap_or(Some(Scope::Admin))
    }
}

fn read_scope(operation: &Value) -> Option<Scope> {
    let wanted = operation["security"].as_array()?.iter().find_map(|way| way.get("key"))?;
    // A security entry without a scope requires admin.
    let scope = wanted.as_array().and_then(|scopes| scopes.first()).and_then(Value::as_str);
    Some(scope.and_then(|word| Scope::try_from(word.to_owned()).ok()).unwrap_or(Scope::Admin))
}
