//! ONNX Runtime: finding and loading the library, opening model files, running them.
//!
//! The library is loaded at run time, once a process, so that a program without models needs none.

use std::{
    env::consts::{DLL_PREFIX, DLL_SUFFIX},
    fmt::Debug,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

use ort::{
    environment::Environment,
    ep,
    logging::LogLevel,
    session::{Session, SessionInputValue, builder::SessionBuilder},
    value::{DynValue, Outlet, PrimitiveTensorElementType, TensorElementType, TensorRef, ValueType},
};

/// Says why a model could not be opened or run.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The library asked for is not there.
    #[error("{}: no such ONNX Runtime library; give the path of libonnxruntime.so (1.17 or newer)", path.display())]
    NoRuntime {
        /// Where it was expected.
        path: PathBuf,
    },
    /// The library does not load.
    #[error(
        "ONNX Runtime: {cause}; install version 1.17 or newer, put libonnxruntime.so beside the program, or give its path"
    )]
    Runtime {
        /// What the loader says; it names the path.
        cause: Box<ort::LoadDynamicError>,
    },
    /// Another library was loaded before.
    #[error("ONNX Runtime is loaded from {}, {} was asked for; use one per process", loaded.display(), asked.display())]
    OtherRuntime {
        /// The library in use.
        loaded: PathBuf,
        /// The library asked for.
        asked: PathBuf,
    },
    /// The library refuses to start.
    #[error("ONNX Runtime does not start: {cause}; check its version (1.17 or newer)")]
    Start {
        /// What it says.
        cause: ort::Error,
    },
    /// The accelerator asked for cannot be used.
    #[error("ONNX Runtime cannot use {provider:?}: {cause}; use a build with it, or the CPU")]
    Provider {
        /// The accelerator.
        provider: Provider,
        /// What the runtime says.
        cause: ort::Error,
    },
    /// The model file cannot be read.
    #[error("{cause}; put the model file there or correct the description")]
    Read {
        /// The operating system's answer, which names the path.
        cause: std::io::Error,
    },
    /// The model file cannot be loaded: cut, not ONNX, or of an unknown version.
    #[error("{}: {cause}; fetch the model file again", path.display())]
    Load {
        /// The model file.
        path: PathBuf,
        /// What the runtime says.
        cause: ort::Error,
    },
    /// The model has no such input or output.
    #[error("{}: no {role} {name:?}, it has {}; correct the description", path.display(), found.join(", "))]
    NoTensor {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// The name asked for.
        name: String,
        /// The names that it has.
        found: Vec<String>,
    },
    /// An input or output is of another type or shape.
    #[error("{}: {role} {name:?} is {found}, expected {expected}; correct the description", path.display())]
    Shape {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// Its name.
        name: String,
        /// Its type and shape.
        found: String,
        /// What is expected; -1 is any size.
        expected: String,
    },
    /// The model is of another layout.
    #[error("{}: {found}; expected {expected}; give the files of one export in their places", path.display())]
    Layout {
        /// The model file.
        path: PathBuf,
        /// What it has.
        found: String,
        /// What is expected.
        expected: String,
    },
    /// Running the model failed.
    #[error("{}: running the model: {cause}; the file does not fit its description", path.display())]
    Run {
        /// The model file.
        path: PathBuf,
        /// What the runtime says.
        cause: ort::Error,
    },
}

/// What a model is run on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Provider {
    /// The processor.
    #[default]
    Cpu,
    /// An NVIDIA GPU; needs a CUDA build of ONNX Runtime.
    Cuda,
}

/// How models are run.
#[derive(Clone, Debug)]
pub struct SessionOptions {
    /// The library, as [`find_runtime`] returns it.
    pub runtime: PathBuf,
    /// Threads within one run; small models are fastest with 1, several sessions then run side by side.
    pub intra_op_threads: usize,
    /// What the model runs on.
    pub provider: Provider,
}

impl SessionOptions {
    /// Returns the options for one thread on the processor.
    pub fn new(runtime: PathBuf) -> Self {
        Self { runtime, intra_op_threads: 1, provider: Provider::Cpu }
    }

    /// Returns whether models are to run on the processor alone.
    pub fn is_on_cpu(&self) -> bool {
        self.provider == Provider::Cpu
    }
}

/// Returns the library's path: `explicit`, else the first of the folders `beside` that has it, else its bare
/// name, for the system's loader to find.
/// # Errors
/// [`SessionError::NoRuntime`] if `explicit` is not a file.
pub fn find_runtime(explicit: Option<&Path>, beside: &[PathBuf]) -> Result<PathBuf, SessionError> {
    if let Some(path) = explicit {
        return if path.is_file() {
            Ok(path.to_owned())
        } else {
            Err(SessionError::NoRuntime { path: path.to_owned() })
        };
    }
    let name = format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}");
    let found = beside.iter().map(|folder| folder.join(&name)).find(|path| path.is_file());
    Ok(found.unwrap_or_else(|| name.into()))
}

/// The library in use and its environment, of which a process may have one only.
static RUNTIME: Mutex<Option<(PathBuf, Environment)>> = Mutex::new(None);

fn environment(runtime: &Path) -> Result<Environment, SessionError> {
    // A relative path with a folder would be looked up beside the program first.
    let path = if runtime.components().count() > 1 {
        runtime.canonicalize().map_err(|_| SessionError::NoRuntime { path: runtime.to_owned() })?
    } else {
        runtime.to_owned()
    };
    let mut loaded = RUNTIME.lock().unwrap_or_else(PoisonError::into_inner);
    match &*loaded {
        Some((loaded, environment)) if *loaded == path => return Ok(environment.clone()),
        Some((loaded, _)) => {
            return Err(SessionError::OtherRuntime { loaded: loaded.clone(), asked: path });
        }
        None => {}
    }
    let environment = ort::init_from(&path)
        .map_err(|cause| SessionError::Runtime { cause: Box::new(cause) })?
        .with_name("slag")
        .with_telemetry(false)
        .with_logger(Arc::new(forward_log))
        .build()
        .map_err(|cause| SessionError::Start { cause })?;
    environment.set_log_level(LogLevel::Warning);
    *loaded = Some((path, environment.clone()));
    Ok(environment)
}

/// Hands the runtime's messages on, which it would print otherwise.
fn forward_log(level: LogLevel, category: &str, _id: &str, _location: &str, message: &str) {
    match level {
        LogLevel::Error | LogLevel::Fatal => tracing::error!(category, "ONNX Runtime: {message}"),
        LogLevel::Warning => tracing::warn!(category, "ONNX Runtime: {message}"),
        LogLevel::Info | LogLevel::Verbose => tracing::debug!(category, "ONNX Runtime: {message}"),
    }
}

/// A tensor of f32, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Tensor {
    pub(crate) shape: Vec<i64>,
    pub(crate) values: Vec<f32>,
}

/// Name, and for tensors element type and shape, where -1 is any size, of an input or output.
pub(crate) type Declared = (String, Option<(TensorElementType, Vec<i64>)>);

fn declared(outlets: &[Outlet]) -> Vec<Declared> {
    let tensor = |outlet: &Outlet| match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => Some((*ty, shape.to_vec())),
        _ => None,
    };
    outlets.iter().map(|outlet| (outlet.name().to_owned(), tensor(outlet))).collect()
}

fn listed(outlets: &[Outlet]) -> String {
    let listed = outlets.iter().map(|outlet| format!("{} {}", outlet.name(), found(outlet)));
    listed.collect::<Vec<_>>().join(", ")
}

/// Returns an input's or output's type and shape for people.
fn found(outlet: &Outlet) -> String {
    match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => format!("{ty} {:?}", &shape[..]),
        other => other.to_string(),
    }
}

/// An opened model file.
#[derive(Debug)]
pub(crate) struct Model {
    path: PathBuf,
    session: Session,
    provider: Provider,
}

impl Model {
    pub(crate) fn open(path: &Path, options: &SessionOptions) -> Result<Self, SessionError> {
        // Before the library is asked for, so that a missing model is named as such.
        fs_err::metadata(path).map_err(|cause| SessionError::Read { cause })?;
        let environment = environment(&options.runtime)?;
        let load = |cause| SessionError::Load { path: path.to_owned(), cause };
        let mut builder = Session::builder(&environment)
            .and_then(|b| b.with_intra_threads(options.intra_op_threads).map_err(ort::Error::from))
            .and_then(|b| b.with_inter_threads(1).map_err(ort::Error::from))
            // A thread that waits must not take a core from the other stages.
            .and_then(|b| b.with_intra_op_spinning(false).map_err(ort::Error::from))
            .map_err(load)?;
        if options.provider == Provider::Cuda {
            builder = with_cuda(builder)
                .map_err(|cause| SessionError::Provider { provider: options.provider, cause })?;
        }
        let session = builder.commit_from_file(path).map_err(load)?;
        tracing::debug!(path = %path.display(), provider = ?options.provider, "model opened");
        Ok(Self { path: path.to_owned(), session, provider: options.provider })
    }

    pub(crate) fn provider(&self) -> Provider {
        self.provider
    }

    /// Checks that input `name` takes `element` tensors of `shape`, where -1 is any size.
    pub(crate) fn expect_input(
        &self,
        name: &str,
        element: TensorElementType,
        shape: &[i64],
    ) -> Result<(), SessionError> {
        self.expect("input", self.session.inputs(), name, element, shape)
    }

    /// Checks that output `name` gives `element` tensors of `shape`, where -1 is any size.
    pub(crate) fn expect_output(
        &self,
        name: &str,
        element: TensorElementType,
        shape: &[i64],
    ) -> Result<(), SessionError> {
        self.expect("output", self.session.outputs(), name, element, shape)
    }

    /// Checks that the model has no input beside `names`.
    pub(crate) fn expect_no_input_but(&self, names: &[&str]) -> Result<(), SessionError> {
        match self.session.inputs().iter().find(|input| !names.contains(&input.name())) {
            None => Ok(()),
            Some(input) => Err(SessionError::Shape {
                path: self.path.clone(),
                role: "input",
                name: input.name().to_owned(),
                found: "required by the model".to_owned(),
                expected: format!("only {}", names.join(", ")),
            }),
        }
    }

    fn expect(
        &self,
        role: &'static str,
        outlets: &[Outlet],
        name: &str,
        element: TensorElementType,
        expected: &[i64],
    ) -> Result<(), SessionError> {
        let outlet =
            outlets.iter().find(|outlet| outlet.name() == name).ok_or_else(|| SessionError::NoTensor {
                path: self.path.clone(),
                role,
                name: name.to_owned(),
                found: outlets.iter().map(|outlet| outlet.name().to_owned()).collect(),
            })?;
        let fits = match outlet.dtype() {
            ValueType::Tensor { ty, shape, .. } => *ty == element && shapes_fit(shape, expected),
            _ => false,
        };
        if fits {
            return Ok(());
        }
        Err(self.shape_error(role, name, found(outlet), element, expected))
    }

    fn shape_error(
        &self,
        role: &'static str,
        name: &str,
        found: String,
        element: TensorElementType,
        expected: &[i64],
    ) -> SessionError {
        SessionError::Shape {
            path: self.path.clone(),
            role,
            name: name.to_owned(),
            found,
            expected: format!("{element} {expected:?}"),
        }
    }

    pub(crate) fn inputs(&self) -> Vec<Declared> {
        declared(self.session.inputs())
    }

    pub(crate) fn outputs(&self) -> Vec<Declared> {
        declared(self.session.outputs())
    }

    pub(crate) fn listed_inputs(&self) -> String {
        listed(self.session.inputs())
    }

    pub(crate) fn listed_outputs(&self) -> String {
        listed(self.session.outputs())
    }

    pub(crate) fn layout_error(&self, found: String, expected: String) -> SessionError {
        SessionError::Layout { path: self.path.clone(), found, expected }
    }

    /// Runs the model on `inputs` and returns the f32 output `name`, which must have exactly `shape`.
    pub(crate) fn run(
        &mut self,
        inputs: Vec<(&str, SessionInputValue<'_>)>,
        name: &str,
        shape: &[i64],
    ) -> Result<Vec<f32>, SessionError> {
        Ok(self.run_all(inputs, &[(name, shape)])?.swap_remove(0).values)
    }

    /// Runs the model on `inputs` and returns the f32 outputs named, in this order; -1 in a shape is any size.
    pub(crate) fn run_all(
        &mut self,
        inputs: Vec<(&str, SessionInputValue<'_>)>,
        outputs: &[(&str, &[i64])],
    ) -> Result<Vec<Tensor>, SessionError> {
        let run = |path: &Path, cause| SessionError::Run { path: path.to_owned(), cause };
        let mut found = self.session.run(inputs).map_err(|cause| run(&self.path, cause))?;
        let values: Vec<_> = outputs.iter().map(|(name, _)| found.remove(name)).collect();
        drop(found);
        let take = |(value, &(name, shape)): (&Option<DynValue>, &(&str, &[i64]))| {
            let found = match value.as_ref().map(DynValue::try_extract_tensor::<f32>) {
                Some(Ok((found, values))) if shapes_fit(found, shape) => {
                    return Ok(Tensor { shape: found.to_vec(), values: values.to_vec() });
                }
                Some(Ok((found, _))) => format!("f32 {:?}", &found[..]),
                Some(Err(cause)) => return Err(run(&self.path, cause)),
                None => "absent".to_owned(),
            };
            Err(self.shape_error("output", name, found, TensorElementType::Float32, shape))
        };
        values.iter().zip(outputs).map(take).collect()
    }

    /// Returns `values` as an input of `shape`.
    pub(crate) fn tensor<'a, T>(
        &self,
        shape: Vec<i64>,
        values: &'a [T],
    ) -> Result<SessionInputValue<'a>, SessionError>
    where
        T: PrimitiveTensorElementType + Clone + Debug + 'static,
    {
        let tensor = TensorRef::from_array_view((shape, values))
            .map_err(|cause| SessionError::Run { path: self.path.clone(), cause })?;
        Ok(tensor.into())
    }
}

fn with_cuda(builder: SessionBuilder) -> ort::Result<SessionBuilder> {
    builder
        .with_execution_providers([ep::CUDA::default().build().error_on_failure()])
        .map_err(ort::Error::from)
}

/// Tells whether a declared shape admits `expected`; -1 on either side is any size.
pub(crate) fn shapes_fit(declared: &[i64], expected: &[i64]) -> bool {
    declared.len() == expected.len()
        && declared.iter().zip(expected).all(|(&d, &e)| d == e || d == -1 || e == -1)
}
