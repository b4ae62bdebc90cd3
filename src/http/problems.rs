//! The problems that routes declare in the API description, by status.

use std::collections::BTreeMap;
use utoipa::IntoResponses;
use utoipa::openapi::response::ResponseBuilder;
use utoipa::openapi::{ContentBuilder, Ref, RefOr, Response};

/// Declares types that stand for problem responses of one or more statuses.
macro_rules! problems {
    ($($(#[$doc:meta])* $name:ident: $($status:literal)+;)+) => {$(
        $(#[$doc])*
        pub struct $name;

        impl IntoResponses for $name {
            fn responses() -> BTreeMap<String, RefOr<Response>> {
                [$($status),+].map(|status: &str| (status.to_owned(), problem())).into()
            }
        }
    )+};
}

problems! {
    /// What every route may answer: a missing key, too many requests.
    Common: "401" "429";
    BadRequest: "400";
    BudgetSpent: "402";
    Forbidden: "403";
    NotFound: "404";
    Timeout: "408";
    Conflict: "409";
    Gone: "410";
    PreconditionFailed: "412";
    TooLarge: "413";
    UnsupportedMediaType: "415";
    Unprocessable: "422";
    Locked: "423";
    ChecksumMismatch: "460";
    BadGateway: "502";
    Unavailable: "503";
    GatewayTimeout: "504";
    StorageFull: "507";
}

/// Titles are set for all routes alike, see [`description`](super::description).
fn problem() -> RefOr<Response> {
    let schema = Ref::from_schema_name("Problem");
    let content = ContentBuilder::new().schema(Some(schema)).build();
    ResponseBuilder::new().content("application/problem+json", content).build().into()
}
