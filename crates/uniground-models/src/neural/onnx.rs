//! ONNX Runtime on this machine. The library is found at run time, and sessions are pooled.

use super::ModelError;
use super::bundle::Bundle;
use super::engine::{Engine, Work};
use super::network::{Element, Input, Network, Port, Signature, Tensor, Values, check_finite};
use camino::{Utf8Path, Utf8PathBuf};
use ort::environment::Environment;
use ort::ep::{self, ExecutionProvider, ExecutionProviderDispatch};
use ort::session::{OutputSelector, RunOptions, Session, SessionInputValue};
use ort::value::{TensorElementType, TensorRef, ValueType};
use serde::{Deserialize, Serialize};
use std::sync::{Condvar, Mutex, PoisonError};
use uniground_geometry::background::run_at_low_priority;

/// The execution provider.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Provider {
    /// CPU cores. Available in every library.
    #[default]
    Cpu,
    /// NVIDIA GPUs.
    Cuda,
    /// NVIDIA GPUs, with `TensorRT`.
    Tensorrt,
    /// Apple chips, with Core ML.
    Coreml,
}

impl std::fmt::Display for Provider {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::Tensorrt => "tensorrt",
            Self::Coreml => "coreml",
        })
    }
}

impl Provider {
    fn dispatch(self) -> ExecutionProviderDispatch {
        match self {
            Self::Cpu => ep::CPU::default().with_arena_allocator(true).build(),
            Self::Cuda => ep::CUDA::default().build(),
            Self::Tensorrt => ep::TensorRT::default().build(),
            Self::Coreml => ep::CoreML::default().build(),
        }
    }

    fn is_built_in(self) -> ort::Result<bool> {
        match self {
            Self::Cpu => Ok(true),
            Self::Cuda => ep::CUDA::is_available(),
            Self::Tensorrt => ep::TensorRT::is_available(),
            Self::Coreml => ep::CoreML::is_available(),
        }
    }
}

/// Where to find ONNX Runtime, and which resources it can use.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RuntimeSettings {
    /// Path of the library. Searched for if not set.
    pub library: Option<Utf8PathBuf>,
    /// Must be built into the library. There is no fallback to another provider.
    pub provider: Provider,
    /// Number of cores per model. All cores if not set.
    pub threads: Option<usize>,
}

/// The loaded library. A process loads it once.
#[derive(Debug, Clone)]
pub struct OnnxRuntime {
    /// The file that was loaded, with symbolic links resolved.
    pub library: Utf8PathBuf,
    /// The execution provider. The library was built with it.
    pub provider: Provider,
    /// Number of cores per model, at least 1.
    pub threads: usize,
    environment: Environment,
}

/// The library that this process has loaded.
static LOADED: Mutex<Option<(Utf8PathBuf, Environment)>> = Mutex::new(None);

const LIBRARY_FILE: &str = if cfg!(target_os = "macos") {
    "libonnxruntime.dylib"
} else if cfg!(windows) {
    "onnxruntime.dll"
} else {
    "libonnxruntime.so"
};

impl OnnxRuntime {
    /// Finds the library like [`load`](Self::load), without loading it.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that lists where it was searched for.
    pub fn find(settings: &RuntimeSettings) -> Result<Utf8PathBuf, ModelError> {
        find_library(settings.library.as_deref())
    }

    /// Finds and loads the library: the configured one, the one in `ORT_DYLIB_PATH`, in
    /// `./.onnxruntime/`, or next to the executable.
    ///
    /// # Errors
    /// Returns a [`ModelError`]: no library, an unusable one, or one without the requested
    /// provider.
    pub fn load(settings: &RuntimeSettings) -> Result<Self, ModelError> {
        let library = Self::find(settings)?;
        let unusable = |why: String| ModelError::BadLibrary { library: library.clone(), why };
        let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
        let environment = match &*loaded {
            Some((there, environment)) if *there == library => environment.clone(),
            Some((there, _)) => {
                return Err(unusable(format!("this process has already loaded {there}")));
            }
            None => {
                let builder =
                    ort::init_from(library.as_std_path()).map_err(|e| unusable(e.to_string()))?;
                let environment = builder
                    .with_name("uniground")
                    .with_telemetry(false)
                    .build()
                    .map_err(|e| unusable(e.to_string()))?;
                *loaded = Some((library.clone(), environment.clone()));
                environment
            }
        };
        let provider = settings.provider;
        let built_in = provider
            .is_built_in()
            .map_err(|e| ModelError::NoProvider { provider, why: e.to_string() })?;
        if !built_in {
            return Err(ModelError::NoProvider {
                provider,
                why: format!("{library} was built without it"),
            });
        }
        let cores = std::thread::available_parallelism().map_or(1, Into::into);
        Ok(Self {
            library,
            provider,
            threads: settings.threads.unwrap_or(cores).max(1),
            environment,
        })
    }

    /// Loads a network. `at_once` sessions share the threads.
    fn load_network(&self, file: &Utf8Path, at_once: usize) -> Result<OnnxNetwork, ModelError> {
        let at_once = at_once.clamp(1, self.threads);
        let wrong = |why: String| ModelError::Bundle { file: file.to_owned(), why };
        if !file.is_file() {
            return Err(wrong("the file is missing".into()));
        }
        let session =
            || self.create_session(file, at_once).map_err(|e| wrong(first_line(&e.to_string())));
        let sessions: Vec<Session> = (0..at_once).map(|_| session()).collect::<Result<_, _>>()?;
        let ports = |outlets: &[ort::value::Outlet]| outlets.iter().map(to_port).collect();
        let signature = Signature {
            inputs: ports(sessions[0].inputs()),
            outputs: ports(sessions[0].outputs()),
        };
        Ok(OnnxNetwork {
            name: file.file_name().unwrap_or("network").into(),
            signature,
            idle: Mutex::new(sessions),
            returned: Condvar::new(),
        })
    }

    fn create_session(&self, file: &Utf8Path, at_once: usize) -> ort::Result<Session> {
        // Idle threads sleep instead of spinning, because the cores have other work. A failing
        // provider is an error, never a silent fallback to another one.
        let builder = Session::builder(&self.environment)?
            .with_intra_threads((self.threads / at_once).max(1))?
            .with_inter_threads(1)?
            .with_intra_op_spinning(false)?
            // A memory plan of one large block, made after the first call, would add to the memory
            // that an encoder's arena already holds.
            .with_memory_pattern(at_once > 1)?
            // On x86 CPUs without VNNI instructions, sums of 8-bit products saturate, and the
            // results of quantized networks are wrong. This computes them with unsigned weights.
            // Other CPUs ignore it.
            .with_config_entry("session.x64quantprecision", "1")?;
        let provider = self.provider.dispatch().error_on_failure();
        builder.with_execution_providers([provider])?.commit_from_file(file)
    }
}

impl Engine for OnnxRuntime {
    fn open(
        &self,
        bundle: &Bundle,
        file: &str,
        at_once: usize,
        work: Work,
    ) -> Result<Box<dyn Network>, ModelError> {
        bundle.external_weights(file)?;
        let load = || self.load_network(&bundle.path(file), at_once);
        let network = match work {
            // A session's own threads inherit the priority of the thread that creates it.
            Work::Parsing => run_at_low_priority(load)?,
            Work::Questions => load()?,
        };
        Ok(Box::new(network))
    }

    fn fingerprint(&self, bundle: &Bundle) -> Result<String, ModelError> {
        bundle.fingerprint(true, &[])
    }

    fn runs_on(&self) -> String {
        self.provider.to_string()
    }

    fn is_accelerated(&self) -> bool {
        self.provider != Provider::Cpu
    }

    fn library(&self) -> Option<String> {
        Some(self.library.file_name().unwrap_or_default().to_owned())
    }
}

fn find_library(told: Option<&Utf8Path>) -> Result<Utf8PathBuf, ModelError> {
    let named = told
        .map(Utf8Path::to_owned)
        .or_else(|| std::env::var("ORT_DYLIB_PATH").ok().filter(|p| !p.is_empty()).map(Into::into));
    let beside = || {
        Utf8PathBuf::from_path_buf(std::env::current_exe().ok()?.parent()?.join(LIBRARY_FILE)).ok()
    };
    let usual = || {
        [Some(Utf8PathBuf::from(".onnxruntime").join(LIBRARY_FILE)), beside()]
            .into_iter()
            .flatten()
            .collect()
    };
    let candidates: Vec<Utf8PathBuf> = named.map_or_else(usual, |file| vec![file]);
    // A missing library must be detected here: loading one can hang forever.
    match candidates.iter().find(|file| file.is_file()) {
        Some(file) => file
            .canonicalize_utf8()
            .map_err(|e| ModelError::BadLibrary { library: file.clone(), why: e.to_string() }),
        None => Err(ModelError::NoLibrary {
            looked_at: candidates.into_iter().map(String::from).collect(),
        }),
    }
}

/// Returns the first line of a runtime message. The runtime's messages can be pages long.
fn first_line(message: &str) -> String {
    message.lines().next().unwrap_or_default().chars().take(300).collect()
}

fn to_port(outlet: &ort::value::Outlet) -> Port {
    let (element, shape) = match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => (
            match ty {
                TensorElementType::Float32 => Element::F32,
                TensorElementType::Int64 => Element::I64,
                _ => Element::Other,
            },
            shape.iter().copied().collect(),
        ),
        _ => (Element::Other, Vec::new()),
    };
    Port { name: outlet.name().to_owned(), element, shape }
}

/// One network with a pool of sessions. Each session serves one caller at a time.
pub struct OnnxNetwork {
    name: String,
    signature: Signature,
    idle: Mutex<Vec<Session>>,
    returned: Condvar,
}

impl OnnxNetwork {
    fn take_session(&self) -> Session {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            match idle.pop() {
                Some(session) => return session,
                None => idle = self.returned.wait(idle).unwrap_or_else(PoisonError::into_inner),
            }
        }
    }

    fn return_session(&self, session: Session) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(session);
        self.returned.notify_one();
    }

    fn run_on(
        session: &mut Session,
        inputs: &[Input],
        outputs: &[&str],
    ) -> ort::Result<Vec<Tensor>> {
        let fed: Vec<(&str, SessionInputValue)> = inputs
            .iter()
            .map(|Input { name, shape, values }| {
                let value = match values {
                    Values::F32(values) => {
                        TensorRef::from_array_view((shape.clone(), *values))?.into()
                    }
                    Values::I64(values) => {
                        TensorRef::from_array_view((shape.clone(), *values))?.into()
                    }
                };
                Ok::<_, ort::Error>((*name, value))
            })
            .collect::<Result<_, _>>()?;
        let wanted = outputs
            .iter()
            .fold(OutputSelector::no_default(), |selector, name| selector.with(*name));
        let options = RunOptions::new()?.with_outputs(wanted);
        let made = session.run_with_options(fed, &options)?;
        outputs
            .iter()
            .map(|name| {
                let (shape, values) = made[*name].try_extract_tensor::<f32>()?;
                Ok(Tensor {
                    shape: shape.iter().map(|&d| d as usize).collect(),
                    values: values.to_vec(),
                })
            })
            .collect()
    }
}

impl Network for OnnxNetwork {
    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn run(&self, inputs: &[Input], outputs: &[&str]) -> Result<Vec<Tensor>, ModelError> {
        let mut session = self.take_session();
        let made = Self::run_on(&mut session, inputs, outputs);
        self.return_session(session);
        let made = made.map_err(|e| ModelError::Run {
            network: self.name.clone(),
            why: first_line(&e.to_string()),
        })?;
        for (tensor, name) in made.iter().zip(outputs) {
            check_finite(&self.name, name, &tensor.values)?;
        }
        Ok(made)
    }
}
