//! `uniground models check-vlm`: shows the configured vision-language model pictures of known content
//! and one question about the sample room, and says what it can do and what it costs.

use super::job_progress;
use super::output::print_json;
use super::private::PrivateServer;
use crate::config::{ModelsConfig, VlmConfig};
use crate::telemetry;
use anyhow::{Context, bail};
use camino::Utf8PathBuf;
use serde_json::json;
use std::io::{self, Write};
use std::time::Instant;
use uniground_client::Client;
use uniground_core::grounding::vlm::reply;
use uniground_core::ingest::archive::ArchiveKind;
use uniground_core::models::chat::{ChatFailure, ChatModel, ChatReply, Prices};
use uniground_endpoints::chat::{ChatClient, ReplayCache};
use uniground_evaluation::model_check::{Finding, check_pictures};
use uniground_service::sample::LIVING_ROOM;
use uniground_types::answer::Answer;
use uniground_types::question::{GroundRequest, ReasonerChoice};

#[derive(Debug, clap::Args)]
pub struct CheckVlmArgs {
    #[command(flatten)]
    vlm: VlmConfig,
    /// Number of questions a day, for the cost of a day
    #[arg(long, default_value_t = 1000, value_name = "N")]
    questions: u32,
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// A question about the sample room whose answer is plain to see.
const QUESTION: &str = "the mug on the coffee table";
/// Names of checks.
const REACHABLE: &str = "reachable";
const SIX_FIELDS: &str = "keeps to the six fields";

/// # Errors
/// Returns an error if no model is configured, or if something is wrong with it.
pub async fn run(args: &CheckVlmArgs) -> anyhow::Result<()> {
    telemetry::start_quiet_about_jobs();
    let client = args
        .vlm
        .client(ReplayCache::default())?
        .context("no model is configured: set --vlm-url and --vlm-model")?;
    let mut check = Check { args, findings: Vec::new() };
    check.run(&client).await?;
    let wrong = check.findings.iter().filter(|finding| !finding.is_right).count();
    if args.json {
        let findings: Vec<_> = check
            .findings
            .iter()
            .map(|f| json!({"what": f.what, "is_right": f.is_right, "detail": f.detail}))
            .collect();
        print_json(&findings)?;
    }
    match wrong {
        0 => Ok(()),
        1 => bail!("one check failed"),
        wrong => bail!("{wrong} checks failed"),
    }
}

struct Check<'a> {
    args: &'a CheckVlmArgs,
    findings: Vec<Finding>,
}

impl Check<'_> {
    async fn run(&mut self, client: &ChatClient) -> anyhow::Result<()> {
        let start = Instant::now();
        if let Err(error) = client.check_reachable().await {
            let detail = format!(
                "{}. Is the server running, and the address right?",
                uniground_core::models::with_causes(&error)
            );
            return self.tell(Finding { what: REACHABLE, is_right: false, detail });
        }
        let detail = format!("It answered in {:.2} s.", start.elapsed().as_secs_f64());
        self.tell(Finding { what: REACHABLE, is_right: true, detail })?;
        let VlmConfig { vlm_json, vlm_points, vlm_max_images, .. } = self.args.vlm;
        for limit in client.describe_limits(vlm_max_images).await {
            self.tell(Finding { what: "takes a question's size", is_right: false, detail: limit })?;
        }
        let limits = self.args.vlm.picture_limits();
        match check_pictures(client, vlm_json, vlm_points.into(), limits).await {
            Ok((findings, reply)) => {
                findings.into_iter().try_for_each(|finding| self.tell(finding))?;
                self.say(&format!("Three pictures took {}.", cost(&reply, client.prices())))?;
            }
            Err(ChatFailure { error, .. }) => {
                let detail = uniground_core::models::with_causes(&error);
                return self.tell(Finding { what: "sees pictures", is_right: false, detail });
            }
        }
        self.ask_question().await
    }

    /// Asks about the sample room, through a service of its own.
    async fn ask_question(&mut self) -> anyhow::Result<()> {
        let data = tempfile::tempdir()?;
        let folder = Utf8PathBuf::try_from(data.path().to_owned())?;
        let service =
            PrivateServer::start_with(folder, ModelsConfig::builtin(), self.args.vlm.clone())
                .await?;
        let asked = self.ask_service(&service.client).await;
        service.stop().await?;
        asked
    }

    async fn ask_service(&mut self, client: &Client) -> anyhow::Result<()> {
        let created =
            client.create_scene(None, ArchiveKind::Zip.media_type(), LIVING_ROOM.to_vec()).await?;
        let job = created.job.context("the server did not start a parse")?;
        job_progress::describe_outcome(&job_progress::follow_job(client, &job.id).await?)?;
        let request =
            GroundRequest { reasoner: ReasonerChoice::Vlm, ..GroundRequest::new(QUESTION) };
        let start = Instant::now();
        let answer = match client.ground(&created.scene.id, &request).await {
            Ok(answer) => answer,
            Err(error) => {
                return self.tell(Finding {
                    what: SIX_FIELDS,
                    is_right: false,
                    detail: format!("The question {QUESTION:?} failed: {error}"),
                });
            }
        };
        let seconds = start.elapsed().as_secs_f64();
        let replies = client.answer_reply(&answer.id).await?;
        let missing: Vec<&str> = replies
            .calls
            .iter()
            .filter_map(|call| call.text.as_deref())
            .flat_map(|text| reply::read(text).not_read)
            .collect();
        let calls = replies.calls.len();
        self.tell(Finding {
            what: SIX_FIELDS,
            is_right: missing.is_empty() && !answer.degraded,
            detail: match missing.is_empty() {
                true => format!("The question {QUESTION:?} took {calls} calls."),
                false => format!(
                    "It left out {}. Try --vlm-json, or a larger model.",
                    missing.join(", ")
                ),
            },
        })?;
        self.say_costs(&answer, seconds)
    }

    fn say_costs(&self, answer: &Answer, seconds: f64) -> anyhow::Result<()> {
        let usage = &answer.usage;
        self.say(&format!(
            "A question took {seconds:.1} s, {} prompt tokens and {} tokens of reply.",
            usage.prompt_tokens, usage.completion_tokens
        ))?;
        let questions = f64::from(self.args.questions);
        let hours = questions * seconds / f64::from(self.args.vlm.vlm_concurrency.max(1)) / 3600.0;
        let price = match usage.cost_usd > 0.0 {
            true => format!("{:.2} US dollars", questions * usage.cost_usd),
            false => "an unknown price (set --vlm-prompt-usd and --vlm-completion-usd)".into(),
        };
        self.say(&format!(
            "{questions} questions a day: {price}, {hours:.1} hours with {} at once.",
            self.args.vlm.vlm_concurrency
        ))
    }

    fn tell(&mut self, finding: Finding) -> anyhow::Result<()> {
        self.say(&finding.to_string())?;
        self.findings.push(finding);
        Ok(())
    }

    /// Prints a line, unless the findings are printed as JSON.
    fn say(&self, line: &str) -> anyhow::Result<()> {
        if !self.args.json {
            writeln!(io::stdout().lock(), "{line}")?;
        }
        Ok(())
    }
}

fn cost(reply: &ChatReply, prices: Prices) -> String {
    let ChatReply { prompt_tokens, completion_tokens, latency_ms, .. } = reply;
    let usd = prices.cost_usd(*prompt_tokens, *completion_tokens);
    let price = if usd > 0.0 { format!(", {usd:.4} US dollars") } else { String::new() };
    format!(
        "{:.1} s, {prompt_tokens} prompt tokens and {completion_tokens} tokens of reply{price}",
        latency_ms / 1e3
    )
}
