//! The service as its users meet it: a real server on port 0, driven through the typed client.

// A helper that can not go on fails its test.
#![allow(clippy::unwrap_used)]
// Tables of cases are long and easy to read.
#![allow(clippy::too_many_lines)]

mod access;
mod approach;
mod archives;
mod backups;
mod bad_input;
mod batch_defaults;
mod batches;
mod care;
mod chat_models;
mod cluster;
mod conventions;
mod corrections;
mod databases;
mod evaluation;
mod export;
mod graph;
mod growth;
mod hurry;
mod imports;
mod keeping;
mod keys;
mod language;
mod layering;
mod litellm;
mod logs;
mod many;
mod mcp;
mod model_choice;
mod moving;
mod neural;
mod openapi;
mod pages;
mod placement;
mod real_models;
mod recovery;
mod requests;
mod restart;
mod resumable;
mod rivals;
mod script;
mod server;
mod session;
mod shared_scenes;
mod slow_clients;
mod snapshots;
mod stage_one;
mod streaming;
mod telemetry;
mod upgrades;
mod uploads;
mod vlm;
mod webhooks;
