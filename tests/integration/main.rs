//! The service as its users meet it: a real server on port 0, driven through the typed client.

mod access;
mod archives;
mod bad_input;
mod layering;
mod openapi;
mod requests;
mod restart;
mod server;
mod session;
mod shared_scenes;
mod streaming;
