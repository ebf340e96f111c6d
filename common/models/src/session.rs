//! Opens model files with ONNX Runtime, checks them against their description, and runs them.

use std::collections::BTreeSet;
use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::fmt::Debug;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ort::ErrorCode;
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::{Session, SessionInputValue};
use ort::value::{
    DynTensor, DynTensorValueType, DynValue, Outlet, PrimitiveTensorElementType, Tensor as OwnedTensor,
    TensorElementType, TensorRef, ValueType,
};
use slag_common::files;

use crate::ModelError;
use crate::file_ref::ModelFile;
use crate::floats::Floats;
use crate::placement::{DeviceMemory, Listener, Placement, forward_log};
use crate::provider::{Provider, names};

pub use crate::error::ModelError as SessionError;

#[derive(Clone, Debug)]
pub struct SessionOptions {
    /// The library, from [`find_runtime`].
    pub runtime: PathBuf,
    /// Threads per run. For small models, 1 and several sessions in parallel are fastest.
    pub intra_op_threads: usize,
    /// Devices in order of preference. Without the CPU among them, it is an error if none can be used.
    pub providers: Vec<Provider>,
    /// As CUDA numbers them.
    pub gpu: u32,
}

impl SessionOptions {
    /// One thread on the CPU.
    pub fn new(runtime: PathBuf) -> Self {
        Self { runtime, intra_op_threads: 1, providers: vec![Provider::Cpu], gpu: 0 }
    }

    pub fn is_on_cpu(&self) -> bool {
        self.providers.first().is_none_or(|first| *first == Provider::Cpu)
    }
}

/// Warns once per message: every thread opens its own models.
fn warn_once(message: String) {
    static LOGGED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    let mut logged = LOGGED.lock().unwrap_or_else(PoisonError::into_inner);
    if !logged.contains(&message) {
        tracing::warn!("{message}");
        logged.insert(message);
    }
}

/// A tensor of f32, row-major.
#[derive(Debug, Default)]
pub(crate) struct Tensor {
    pub(crate) shape: Vec<i64>,
    pub(crate) values: Floats,
}

/// Name of an input or output and, for tensors, element type and shape; -1 is any size.
pub(crate) type Declared = (String, Option<(TensorElementType, Vec<i64>)>);

pub(crate) fn declared(outlets: &[Outlet]) -> Vec<Declared> {
    let tensor = |outlet: &Outlet| match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => Some((*ty, shape.to_vec())),
        _ => None,
    };
    outlets.iter().map(|outlet| (outlet.name().to_owned(), tensor(outlet))).collect()
}

/// Lists inputs or outputs with their types.
pub(crate) fn listed(outlets: &[Outlet]) -> Vec<String> {
    outlets.iter().map(|outlet| format!("{} {}", outlet.name(), type_of(outlet))).collect()
}

/// The inner error is a provider that cannot be used.
type Committed = Result<(Session, Placement), (Provider, ort::Error)>;

#[derive(Debug)]
pub(crate) struct Model {
    pub(crate) path: PathBuf,
    pub(crate) session: Session,
    pub(crate) placement: Placement,
    /// Memory of the model's GPU; `None` where tensors cannot be bound to it.
    pub(crate) memory: Option<DeviceMemory>,
}

pub(crate) struct Slot {
    pub name: String,
    pub element: TensorElementType,
    /// Its shape; -1 is any size.
    pub shape: Vec<i64>,
}

impl Model {
    pub(crate) fn open(file: &ModelFile, options: &SessionOptions) -> Result<Self, ModelError> {
        Self::open_sized(file, options, None)
    }

    /// Opens the model for one size of a named dimension, to compute dependent values only once.
    pub(crate) fn open_sized(
        file: &ModelFile,
        options: &SessionOptions,
        size: Option<(&str, i64)>,
    ) -> Result<Self, ModelError> {
        let path = &*file.path;
        // Checked before the library is loaded, so that a missing model is reported as such.
        if file.embedded.is_none() {
            files::metadata(path).map_err(|cause| ModelError::unreadable(&cause))?;
        }
        let environment = environment(&options.runtime)?;
        let mut wanted = options.providers.clone();
        // Providers after the CPU are never used, because the CPU can run everything.
        let end = wanted.iter().position(|&p| p == Provider::Cpu);
        let may_be_cpu = end.is_some() || wanted.is_empty();
        wanted.truncate(end.unwrap_or(wanted.len()));
        let asked = wanted.clone();
        let (session, placement) = loop {
            let committed = Self::commit(file, options, &environment, (&wanted, !asked.is_empty()), size)?;
            let (provider, cause) = match committed {
                Ok(committed) => break committed,
                Err(refused) => refused,
            };
            wanted.retain(|&p| p != provider);
            let refusal = format!(
                "ONNX Runtime cannot use {provider}: {cause}; install its drivers and a libonnxruntime built with it \
                 (onnxruntime-gpu for cuda and tensorrt), or allow the CPU as well: {provider},cpu"
            );
            if wanted.is_empty() && !may_be_cpu {
                return Err(ModelError(refusal));
            }
            warn_once(refusal);
        };
        let placement = placement.of_asked(&asked);
        if placement.provider() == Provider::Cpu && !asked.is_empty() {
            let asked = names(&asked);
            if !may_be_cpu {
                let fault = format!(
                    "runs on {placement} only, but {asked} is requested; use another export of the model, or add cpu to \
                     allow the CPU as well"
                );
                return Err(ModelError::at(path, fault));
            }
            warn_once(format!("{} runs on the CPU instead of {asked}", path.display()));
        }
        tracing::debug!("{} runs on {placement}", path.display());
        let memory = matches!(placement.provider(), Provider::Cuda | Provider::TensorRt)
            .then(|| DeviceMemory::of_gpu(&session, options.gpu))
            .transpose()
            .map_err(|cause| unloadable(path, &cause))?;
        Ok(Self { path: path.to_owned(), session, placement, memory })
    }

    /// `listens`: determine the placement of its nodes.
    fn commit(
        file: &ModelFile,
        options: &SessionOptions,
        environment: &Environment,
        (providers, listens): (&[Provider], bool),
        size: Option<(&str, i64)>,
    ) -> Result<Committed, ModelError> {
        let load = |cause: ort::Error| unloadable(&file.path, &cause);
        let mut builder = Session::builder(environment)
            .and_then(|b| b.with_intra_threads(options.intra_op_threads).map_err(ort::Error::from))
            .and_then(|b| b.with_inter_threads(1).map_err(ort::Error::from))
            // Idle threads must not take cores from the other stages.
            .and_then(|b| b.with_intra_op_spinning(false).map_err(ort::Error::from))
            .map_err(load)?;
        if let Some((dimension, size)) = size {
            builder = builder
                .with_dimension_override(dimension, size)
                .map_err(|cause| load(ort::Error::from(cause)))?;
        }
        let listener = Listener::default();
        if listens {
            builder = listener.attach(builder).map_err(load)?;
        }
        for &provider in providers {
            builder = match provider.register(builder, options.gpu) {
                Ok(builder) => builder,
                Err(cause) => return Ok(Err((provider, cause))),
            };
        }
        let committed = match file.embedded {
            Some(bytes) => builder.commit_from_memory(bytes),
            None => builder.commit_from_file(&file.path),
        };
        let cause = match committed {
            Ok(session) => return Ok(Ok((session, listener.placement()))),
            Err(cause) => cause,
        };
        match (providers.first(), cause.code()) {
            (None, _) | (_, ErrorCode::InvalidProtobuf | ErrorCode::InvalidGraph | ErrorCode::NoModel) => {
                Err(load(cause))
            }
            // The runtime looks for devices and drivers only here.
            (Some(&provider), _) => Ok(Err((provider, cause))),
        }
    }

    pub(crate) fn run_error(&self, cause: ort::Error) -> ModelError {
        let advice = "check that the file fits its description";
        ModelError::at(&self.path, format_args!("the model fails to run: {cause}; {advice}"))
    }

    /// The name of a dimension of any size of input `name`.
    pub(crate) fn dimension(&self, name: &str, axis: usize) -> Option<String> {
        let input = self.session.inputs().iter().find(|input| input.name() == name)?;
        let ValueType::Tensor { shape, dimension_symbols, .. } = input.dtype() else { return None };
        let symbol = dimension_symbols.get(axis).filter(|symbol| !symbol.is_empty())?;
        (shape.get(axis) == Some(&-1)).then(|| symbol.clone())
    }

    /// The element type of input `name`, if it exists and is a tensor.
    pub(crate) fn input_element(&self, name: &str) -> Option<TensorElementType> {
        let input = self.session.inputs().iter().find(|input| input.name() == name)?;
        input.dtype().tensor_type()
    }

    /// Returns input `name` (`None`: the only one that fits) if it has `shape` (-1: any size) and takes `element`,
    /// or f16 for f32.
    pub(crate) fn expect_input<'a>(
        &self,
        name: impl Into<Option<&'a str>>,
        element: TensorElementType,
        shape: &[i64],
    ) -> Result<Slot, ModelError> {
        self.expect("input", self.session.inputs(), name.into(), element, shape)
    }

    /// The same of an output.
    pub(crate) fn expect_output<'a>(
        &self,
        name: impl Into<Option<&'a str>>,
        element: TensorElementType,
        shape: &[i64],
    ) -> Result<Slot, ModelError> {
        self.expect("output", self.session.outputs(), name.into(), element, shape)
    }

    pub(crate) fn expect_no_input_but(&self, names: &[&str]) -> Result<(), ModelError> {
        let other = self.session.inputs().iter().find(|input| !names.contains(&input.name()));
        other.map_or(Ok(()), |input| {
            let expected = format!("only {}", names.join(", "));
            Err(self.shape_error("input", input.name(), "required by the model", &expected))
        })
    }

    fn expect(
        &self,
        role: &'static str,
        outlets: &[Outlet],
        name: Option<&str>,
        element: TensorElementType,
        expected: &[i64],
    ) -> Result<Slot, ModelError> {
        let slot_of = |outlet: &Outlet| match outlet.dtype() {
            ValueType::Tensor { ty, shape, .. }
                if is_element(*ty, element) && shapes_fit(shape, expected) =>
            {
                Some(Slot { name: outlet.name().to_owned(), element: *ty, shape: shape.to_vec() })
            }
            _ => None,
        };
        let wanted = format!("{element} {expected:?}");
        let Some(name) = name else {
            let mut fitting = outlets.iter().filter_map(slot_of);
            return match (fitting.next(), fitting.next()) {
                (Some(slot), None) => Ok(slot),
                _ => {
                    let found = listed(outlets).join(", ");
                    let fault = format!(
                        "the description names no {role}, and not exactly one of {found} is {wanted}; name it in the \
                         description"
                    );
                    Err(ModelError::at(&self.path, fault))
                }
            };
        };
        let Some(outlet) = outlets.iter().find(|outlet| outlet.name() == name) else {
            let found = outlets.iter().map(Outlet::name).collect::<Vec<_>>().join(", ");
            let fault = format!("no {role} {name:?}, it has {found}; correct the description");
            return Err(ModelError::at(&self.path, fault));
        };
        slot_of(outlet).ok_or_else(|| self.shape_error(role, name, &type_of(outlet), &wanted))
    }

    /// The error of a model that takes only one length of text.
    pub(crate) fn fixed_tokens(&self, slot: &Slot) -> ModelError {
        let n = slot.shape[1];
        let expected = format!(
            "text.padding = {{ n_tokens = {n}, token_id = the model's }}, or a model with any number of tokens"
        );
        self.shape_error("input", &slot.name, &format!("{} {:?}", slot.element, slot.shape), &expected)
    }

    fn shape_error(&self, role: &str, name: &str, found: &str, expected: &str) -> ModelError {
        let fault = format_args!("{role} {name:?} is {found}, expected {expected}; correct the description");
        ModelError::at(&self.path, fault)
    }

    pub(crate) fn layout_error(&self, found: &str, expected: &str) -> ModelError {
        let advice = "use the files of one export, each in its field";
        ModelError::at(&self.path, format_args!("{found}; expected {expected}; {advice}"))
    }

    /// Runs the model; returns the f32 output `name`, which must have exactly `shape`.
    pub(crate) fn run(
        &mut self,
        inputs: Vec<(&str, SessionInputValue<'_>)>,
        name: &str,
        shape: &[i64],
    ) -> Result<Vec<f32>, ModelError> {
        let tensor = |value: DynValue| value.downcast::<DynTensorValueType>().ok();
        let found = self.session.run(inputs).map(|mut found| found.remove(name).and_then(tensor));
        let found = found.map_err(|cause| self.run_error(cause))?;
        Ok(self.floats(found, name, shape)?.values.into_vec())
    }

    /// Values of output `name`, f32 or f16, which must fit `shape`; -1 is any size.
    pub(crate) fn floats(
        &self,
        value: Option<DynTensor>,
        name: &str,
        shape: &[i64],
    ) -> Result<Tensor, ModelError> {
        let of = |shape: &[i64]| format!("{} {shape:?}", TensorElementType::Float32);
        let wrong = |found: &str| self.shape_error("output", name, found, &of(shape));
        let value = value.ok_or_else(|| wrong("absent"))?;
        let (found, values) = Floats::of(value).map_err(|cause| self.run_error(cause))?;
        match shapes_fit(&found, shape) {
            true => Ok(Tensor { shape: found, values }),
            false => Err(wrong(&of(&found))),
        }
    }

    pub(crate) fn tensor<'a, T>(
        &self,
        shape: Vec<i64>,
        values: &'a [T],
    ) -> Result<SessionInputValue<'a>, ModelError>
    where
        T: PrimitiveTensorElementType + Clone + Debug + 'static,
    {
        let tensor = TensorRef::from_array_view((shape, values)).map_err(|cause| self.run_error(cause))?;
        Ok(tensor.into())
    }

    pub(crate) fn owned<T>(&self, shape: Vec<i64>, values: Vec<T>) -> Result<DynTensor, ModelError>
    where
        T: PrimitiveTensorElementType + Clone + Debug + 'static,
    {
        let tensor = OwnedTensor::from_array((shape, values)).map_err(|cause| self.run_error(cause))?;
        Ok(tensor.upcast())
    }

    /// An input of `shape`, i32 or i64.
    pub(crate) fn integers(
        &self,
        shape: Vec<i64>,
        values: impl Iterator<Item = u32>,
        is_i32: bool,
    ) -> Result<SessionInputValue<'static>, ModelError> {
        Ok(match is_i32 {
            true => self.owned(shape, values.map(|v| v as i32).collect())?,
            false => self.owned(shape, values.map(i64::from).collect())?,
        }
        .into())
    }
}

fn unloadable(path: &Path, cause: &ort::Error) -> ModelError {
    let says = cause.message();
    let advice = match says.contains("opset") || says.contains("IR version") {
        true => "give a newer libonnxruntime, or export the model for an older opset (all support 17)",
        false => "fetch the model file again",
    };
    ModelError::at(path, format_args!("{cause}; {advice}"))
}

fn type_of(outlet: &Outlet) -> String {
    match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => format!("{ty} {:?}", &shape[..]),
        other => other.to_string(),
    }
}

/// Accepts f16 for f32, which is converted.
fn is_element(found: TensorElementType, expected: TensorElementType) -> bool {
    found == expected || (expected, found) == (TensorElementType::Float32, TensorElementType::Float16)
}

/// -1 on either side is any size.
pub(crate) fn shapes_fit(declared: &[i64], expected: &[i64]) -> bool {
    declared.len() == expected.len()
        && declared.iter().zip(expected).all(|(&d, &e)| d == e || d == -1 || e == -1)
}

/// Path of the library: `explicit`, else in the first of the folders `beside` that has it, else its bare name for the
/// system's loader.
pub fn find_runtime(explicit: Option<&Path>, beside: &[PathBuf]) -> Result<PathBuf, ModelError> {
    if let Some(path) = explicit {
        return if path.is_file() { Ok(path.to_owned()) } else { Err(no_runtime(path)) };
    }
    let name = format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}");
    let found = beside.iter().map(|folder| folder.join(&name)).find(|path| path.is_file());
    Ok(found.unwrap_or_else(|| name.into()))
}

fn no_runtime(path: &Path) -> ModelError {
    let fault = "no such ONNX Runtime library; `scripts/get-onnxruntime.sh` downloads one and prints its path, which \
                 --runtime takes";
    ModelError::at(path, fault)
}

/// The loaded library and its environment; a process has only one.
static RUNTIME: Mutex<Option<(PathBuf, Environment)>> = Mutex::new(None);

/// Loads the library on first use.
pub(crate) fn environment(runtime: &Path) -> Result<Environment, ModelError> {
    // The loader would try a relative path beside the program first.
    let path = if runtime.components().count() > 1 {
        runtime.canonicalize().map_err(|_| no_runtime(runtime))?
    } else {
        runtime.to_owned()
    };
    let mut loaded = RUNTIME.lock().unwrap_or_else(PoisonError::into_inner);
    match &*loaded {
        Some((loaded, environment)) if *loaded == path => return Ok(environment.clone()),
        Some((loaded, _)) => {
            let (loaded, asked) = (loaded.display(), path.display());
            return Err(ModelError(format!(
                "ONNX Runtime is already loaded from {loaded}, but {asked} is requested; use one per process"
            )));
        }
        None => {}
    }
    let unfit = |cause: ort::LoadDynamicError| {
        ModelError(format!(
            "ONNX Runtime: {cause}; version 1.17 or newer is needed: `scripts/get-onnxruntime.sh` downloads it and \
             prints its path, which --runtime takes; beside the program it is found by itself"
        ))
    };
    let advice = "check its version (1.17 or newer)";
    let environment = ort::init_from(&path)
        .map_err(unfit)?
        .with_name("slag")
        .with_telemetry(false)
        .with_logger(Arc::new(forward_log))
        .build()
        .map_err(|cause| ModelError(format!("ONNX Runtime does not start: {cause}; {advice}")))?;
    environment.set_log_level(LogLevel::Warning);
    *loaded = Some((path, environment.clone()));
    Ok(environment)
}
