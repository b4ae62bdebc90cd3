//! `uniground worker`: processes jobs for servers on the same database, until SIGTERM, SIGHUP or
//! Ctrl-C.

use super::serve;
use crate::app;
use crate::config::WorkerConfig;

pub async fn run(config: &WorkerConfig) -> anyhow::Result<()> {
    serve::until_stopped(&config.serve, app::start_role(&config.serve, &config.into())).await
}
