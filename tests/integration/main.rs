//! Integration tests: a real server on port 0, driven through the typed client.

// A helper that fails aborts its test.
#![allow(clippy::unwrap_used)]
// Tables of cases are long and easy to read.
#![allow(clippy::too_many_lines)]

mod approach;
mod backups;
mod batch_defaults;
mod batches;
mod chat_models;
mod check_vlm;
mod cluster;
mod command_line;
mod concurrency;
mod coordinate_conventions;
mod corrections;
mod coverage;
mod data_migration;
mod databases;
mod drafts;
mod evaluation;
mod export;
mod graph;
mod growth;
mod imports;
mod invalid_requests;
mod invalid_scans;
mod keys;
mod language;
mod layering;
mod litellm;
mod local_hub;
mod logs;
mod maintenance;
mod many_scenes;
mod mcp;
mod model_choice;
mod model_hub;
mod neural;
mod openapi;
mod placement;
mod questions;
mod real_models;
mod restart;
mod resumable_uploads;
mod retention;
mod scenes;
mod scripted_model;
mod sessions;
mod shared_scenes;
mod slow_clients;
mod snapshots;
mod stage_one;
mod telemetry;
mod test_scans;
mod test_server;
mod upgrades;
mod uploads;
mod vlm;
mod web_pages;
mod webhooks;
