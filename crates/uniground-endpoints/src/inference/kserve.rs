//! Networks behind a server of the `KServe` v2 protocol (Triton, `MLServer`, `OpenVINO` Model
//! Server, `KServe`).
//!
//! Tensors are sent as raw bytes after a JSON header, by the protocol's binary extension. Servers
//! without that extension get JSON.

use reqwest::StatusCode;
use reqwest::blocking::{Client, RequestBuilder, Response};
use reqwest::header::{CONTENT_TYPE, RETRY_AFTER};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::io::Read;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::Duration;
use uniground_client::{install_crypto_provider, is_local};
use uniground_models::neural::bundle::Bundle;
use uniground_models::neural::network::{
    Element, Input, Network, Port, Signature, Tensor, Values, check_finite,
};
use uniground_models::neural::{Engine, ModelError, Work};
use uniground_models::with_causes;

const HEADER_LENGTH: &str = "Inference-Header-Content-Length";
const ATTEMPTS: u32 = 4;
const MIN_BACKOFF: Duration = Duration::from_millis(250);
const MAX_BACKOFF: Duration = Duration::from_secs(10);
/// Larger responses are rejected.
const MAX_ANSWER_BYTES: u64 = 1 << 30;

/// An inference server and a timeout for its calls.
#[derive(Debug, Clone)]
pub struct RemoteServer {
    address: String,
    client: Client,
}

#[derive(Debug, Deserialize)]
struct Metadata {
    #[serde(default)]
    versions: Option<Vec<String>>,
    #[serde(default)]
    platform: String,
    #[serde(default)]
    inputs: Vec<PortMetadata>,
    #[serde(default)]
    outputs: Vec<PortMetadata>,
}

#[derive(Debug, Deserialize)]
struct PortMetadata {
    name: String,
    datatype: String,
    shape: Vec<i64>,
}

impl PortMetadata {
    fn port(self) -> Port {
        let Self { name, datatype, shape } = self;
        let element = match datatype.as_str() {
            "FP32" => Element::F32,
            "INT64" => Element::I64,
            _ => Element::Other,
        };
        Port { name, element, shape }
    }
}

impl RemoteServer {
    /// Creates a client of a server at an address like `http://host:8000`. `timeout` applies to
    /// every call. Must be called outside of async code.
    ///
    /// # Errors
    /// [`ModelError::Remote`] when the HTTP client cannot be created.
    pub fn new(address: &str, timeout: Duration) -> Result<Self, ModelError> {
        install_crypto_provider();
        let address = address.trim_end_matches('/').to_owned();
        let builder = Client::builder().timeout(timeout).connect_timeout(timeout.min(MAX_BACKOFF));
        let builder = if is_local(&address) { builder.no_proxy() } else { builder };
        let client = builder
            .build()
            .map_err(|e| ModelError::Remote { network: address.clone(), why: with_causes(&e) })?;
        Ok(Self { address, client })
    }

    /// Reads the metadata of a model.
    ///
    /// # Errors
    /// [`ModelError::Remote`]: unreachable, unknown model, or an invalid response.
    fn network(&self, name: &str) -> Result<RemoteNetwork, ModelError> {
        let url = format!("{}/v2/models/{name}", self.address);
        let wrong = |why: String| ModelError::Remote { network: name.to_owned(), why };
        let answer = send_with_retries(|| self.client.get(&url)).map_err(&wrong)?;
        let text = read_limited(answer).map_err(&wrong)?;
        let Metadata { versions, platform, inputs, outputs } = serde_json::from_slice(&text)
            .map_err(|e| wrong(format!("{url} returned invalid model metadata: {e}")))?;
        let ports =
            |described: Vec<PortMetadata>| described.into_iter().map(PortMetadata::port).collect();
        Ok(RemoteNetwork {
            identity: format!("{name} {platform} {}", versions.unwrap_or_default().join(",")),
            url: format!("{url}/infer"),
            name: name.to_owned(),
            client: self.client.clone(),
            signature: Signature { inputs: ports(inputs), outputs: ports(outputs) },
            plain: AtomicBool::new(false),
        })
    }
}

impl Engine for RemoteServer {
    fn open(
        &self,
        bundle: &Bundle,
        file: &str,
        _at_once: usize,
        _work: Work,
    ) -> Result<Box<dyn Network>, ModelError> {
        Ok(Box::new(self.network(&network_name(bundle, file))?))
    }

    fn fingerprint(&self, bundle: &Bundle) -> Result<String, ModelError> {
        let (networks, _) = bundle.files();
        let identities = networks
            .into_iter()
            .map(|file| Ok(self.network(&network_name(bundle, file))?.identity))
            .collect::<Result<Vec<_>, ModelError>>()?;
        bundle.fingerprint(false, &identities)
    }

    fn runs_on(&self) -> String {
        self.address.clone()
    }

    fn library(&self) -> Option<String> {
        None
    }
}

/// Returns the name of a bundle's network at an inference server: the bundle's name and the file's
/// name, without its extension.
fn network_name(bundle: &Bundle, file: &str) -> String {
    // Exporters of SAM write `NAME.encoder.onnx` and `NAME.decoder.onnx`.
    format!("{}-{}", bundle.name(), file.rsplit_once('.').map_or(file, |(stem, _)| stem))
}

struct RemoteNetwork {
    name: String,
    url: String,
    client: Client,
    signature: Signature,
    /// Whether the server rejects raw bytes.
    plain: AtomicBool,
    /// Name, platform and versions, as reported by the server.
    identity: String,
}

#[derive(Serialize)]
struct Header<'a> {
    /// Optional in the protocol, but some servers fail without it.
    id: &'a str,
    inputs: Vec<Value>,
    outputs: Vec<RequestedOutput<'a>>,
}

#[derive(Serialize)]
struct RequestedOutput<'a> {
    name: &'a str,
    parameters: Value,
}

#[derive(Deserialize)]
struct Answer {
    outputs: Vec<AnswerTensor>,
}

#[derive(Deserialize)]
struct AnswerTensor {
    name: String,
    datatype: String,
    shape: Vec<usize>,
    #[serde(default)]
    data: Option<Value>,
    #[serde(default)]
    parameters: Option<AnswerParameters>,
}

#[derive(Deserialize)]
struct AnswerParameters {
    binary_data_size: Option<usize>,
}

impl Network for RemoteNetwork {
    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn run(&self, inputs: &[Input], outputs: &[&str]) -> Result<Vec<Tensor>, ModelError> {
        let wrong = |why: String| ModelError::Remote { network: self.name.clone(), why };
        let answer = self.send_request(inputs, outputs).map_err(&wrong)?;
        let made = read_answer(answer, outputs).map_err(&wrong)?;
        for (tensor, name) in made.iter().zip(outputs) {
            check_finite(&self.name, name, &tensor.values)?;
        }
        Ok(made)
    }
}

impl RemoteNetwork {
    /// Sends a request. Uses raw bytes unless the server has rejected them before.
    fn send_request(&self, inputs: &[Input], outputs: &[&str]) -> Result<Response, String> {
        if !self.plain.load(Ordering::Relaxed) {
            let (header, body) = binary_request(inputs, outputs);
            let request = || {
                let post = self.client.post(&self.url).header(HEADER_LENGTH, header);
                post.header(CONTENT_TYPE, "application/octet-stream").body(body.clone())
            };
            match send_with_retries(request) {
                Ok(answer) => return Ok(answer),
                Err(why) if !why.starts_with(REFUSED) => return Err(why),
                Err(_) => {}
            }
        }
        let body = plain_request(inputs, outputs);
        let answer = send_with_retries(|| {
            self.client.post(&self.url).header(CONTENT_TYPE, "application/json").body(body.clone())
        })?;
        self.plain.store(true, Ordering::Relaxed);
        Ok(answer)
    }
}

fn datatype(values: Values) -> &'static str {
    match values {
        Values::F32(_) => "FP32",
        Values::I64(_) => "INT64",
    }
}

/// Returns the length of the JSON header, and the body with header and tensors.
fn binary_request(inputs: &[Input], outputs: &[&str]) -> (usize, Vec<u8>) {
    let bytes_of = |values: Values| match values {
        Values::F32(values) => values.len() * 4,
        Values::I64(values) => values.len() * 8,
    };
    let described = |i: &Input| json!({"name": i.name, "shape": i.shape, "datatype": datatype(i.values), "parameters": {"binary_data_size": bytes_of(i.values)}});
    let header = Header {
        id: "uniground",
        inputs: inputs.iter().map(described).collect(),
        outputs: outputs
            .iter()
            .map(|name| RequestedOutput { name, parameters: json!({"binary_data": true}) })
            .collect(),
    };
    let mut body = json!(header).to_string().into_bytes();
    let length = body.len();
    for input in inputs {
        match input.values {
            Values::F32(values) => body.extend(values.iter().flat_map(|v| v.to_le_bytes())),
            Values::I64(values) => body.extend(values.iter().flat_map(|v| v.to_le_bytes())),
        }
    }
    (length, body)
}

fn plain_request(inputs: &[Input], outputs: &[&str]) -> Vec<u8> {
    let described = |i: &Input| {
        let data = match i.values {
            Values::F32(values) => json!(values),
            Values::I64(values) => json!(values),
        };
        json!({"name": i.name, "shape": i.shape, "datatype": datatype(i.values), "data": data})
    };
    let header = Header {
        id: "uniground",
        inputs: inputs.iter().map(described).collect(),
        outputs: outputs
            .iter()
            .map(|name| RequestedOutput { name, parameters: json!({"binary_data": false}) })
            .collect(),
    };
    json!(header).to_string().into_bytes()
}

/// Returns the requested tensors, in order, from a binary or JSON response.
fn read_answer(answer: Response, outputs: &[&str]) -> Result<Vec<Tensor>, String> {
    let header_length = answer
        .headers()
        .get(HEADER_LENGTH)
        .and_then(|v| v.to_str().ok())
        .and_then(|v| v.parse::<usize>().ok());
    let body = read_limited(answer)?;
    let (header, mut raw) = match header_length {
        Some(length) if length <= body.len() => body.split_at(length),
        Some(_) => return Err("the response is shorter than its header length".into()),
        None => (&body[..], &[][..]),
    };
    let Answer { outputs: tensors } =
        serde_json::from_slice(header).map_err(|e| format!("the response is invalid: {e}"))?;
    let mut read = Vec::with_capacity(tensors.len());
    for AnswerTensor { name, datatype, shape, data, parameters } in tensors {
        let count = shape
            .iter()
            .try_fold(1_usize, |product, d| product.checked_mul(*d))
            .ok_or_else(|| format!("{name}: the shape {shape:?} is too large"))?;
        let size = parameters.and_then(|p| p.binary_data_size);
        let bytes = size
            .map(|size| {
                raw.split_at_checked(size)
                    .ok_or_else(|| format!("{name}: the response is truncated"))
            })
            .transpose()?;
        if let Some((_, rest)) = bytes {
            raw = rest;
        }
        if !outputs.contains(&name.as_str()) {
            continue;
        }
        if datatype != "FP32" {
            return Err(format!("{name} is {datatype}, expected FP32"));
        }
        let values: Vec<f32> = match (bytes, data) {
            (Some((bytes, _)), _) => {
                bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
            }
            (None, Some(data)) => {
                flatten(&data).ok_or_else(|| format!("{name}: some values are not numbers"))?
            }
            (None, None) => return Err(format!("{name} has no values")),
        };
        if values.len() != count {
            return Err(format!("{name}: {} values for the shape {shape:?}", values.len()));
        }
        read.push((name, Tensor { shape, values }));
    }
    outputs
        .iter()
        .map(|wanted| {
            let at = read
                .iter()
                .position(|(name, _)| name == wanted)
                .ok_or_else(|| format!("{wanted} is missing in the response"))?;
            Ok(read.swap_remove(at).1)
        })
        .collect()
}

/// Flattens a JSON list, nested or flat, into numbers.
fn flatten(data: &Value) -> Option<Vec<f32>> {
    fn collect(value: &Value, values: &mut Vec<f32>) -> bool {
        match value {
            Value::Array(inner) => inner.iter().all(|v| collect(v, values)),
            Value::Number(number) => number.as_f64().is_some_and(|v| {
                values.push(v as f32);
                true
            }),
            _ => false,
        }
    }
    let mut values = Vec::new();
    collect(data, &mut values).then_some(values)
}

/// Prefix of errors of a reachable server that rejects a request.
const REFUSED: &str = "refused";

/// Repeats a request until it is answered, refused, or out of attempts.
fn send_with_retries(request: impl Fn() -> RequestBuilder) -> Result<Response, String> {
    let mut wait = MIN_BACKOFF;
    let mut attempt = 1;
    loop {
        let (why, told) = match request().send() {
            Ok(answer) if answer.status().is_success() => return Ok(answer),
            Ok(answer) => {
                let status = answer.status();
                let told = answer
                    .headers()
                    .get(RETRY_AFTER)
                    .and_then(|v| v.to_str().ok()?.parse().ok())
                    .map(Duration::from_secs);
                let text = read_limited(answer).unwrap_or_default();
                let why = format!(
                    "{status}: {}",
                    String::from_utf8_lossy(&text).chars().take(200).collect::<String>()
                );
                if !is_retryable(status) {
                    return Err(format!("{REFUSED} with {why}"));
                }
                (why, told)
            }
            Err(error) => (with_causes(&error), None),
        };
        if attempt == ATTEMPTS {
            return Err(format!("{why} ({ATTEMPTS} attempts)"));
        }
        sleep(told.unwrap_or(wait).min(MAX_BACKOFF));
        wait *= 2;
        attempt += 1;
    }
}

fn is_retryable(status: StatusCode) -> bool {
    matches!(status.as_u16(), 408 | 425 | 429 | 502 | 503 | 504)
}

fn read_limited(answer: Response) -> Result<Vec<u8>, String> {
    let mut body = Vec::new();
    let read = answer.take(MAX_ANSWER_BYTES + 1).read_to_end(&mut body);
    read.map_err(|e| with_causes(&e))?;
    if body.len() as u64 > MAX_ANSWER_BYTES {
        return Err("the response is larger than 1 GiB".into());
    }
    Ok(body)
}
