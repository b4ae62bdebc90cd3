//! The interface of a network: named tensors in, named tensors out, wherever it runs.

use super::ModelError;
use camino::Utf8Path;

/// Input values, row-major.
#[derive(Debug, Clone, Copy)]
pub enum Values<'a> {
    /// 32-bit floats: pictures, points, features.
    F32(&'a [f32]),
    /// 64-bit integers: token ids.
    I64(&'a [i64]),
}

/// An input tensor.
#[derive(Debug, Clone)]
pub struct Input<'a> {
    /// Name of the network's input.
    pub name: &'a str,
    /// Size of each dimension, batch first.
    pub shape: Vec<usize>,
    /// Values. Their number is the product of the sizes in `shape`.
    pub values: Values<'a>,
}

/// An output tensor: 32-bit floats, row-major, all of them finite.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Size of each dimension, batch first.
    pub shape: Vec<usize>,
    /// Values. Their number is the product of the sizes in `shape`.
    pub values: Vec<f32>,
}

/// The type of a tensor's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    F32,
    /// 64-bit integers.
    I64,
    /// Any other type. No supported network needs it.
    Other,
}

/// An input or output as the network declares it. A dimension of -1 has any size.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Port {
    /// Name of the port, unique among the network's inputs or outputs.
    pub name: String,
    /// Type of its values.
    pub element: Element,
    /// Size of each dimension, batch first.
    pub shape: Vec<i64>,
}

/// The inputs and outputs of a network.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Signature {
    /// Inputs, in the network's order.
    pub inputs: Vec<Port>,
    /// Outputs, in the network's order.
    pub outputs: Vec<Port>,
}

/// A network that runs in this process ([`OnnxRuntime`](super::OnnxRuntime)) or elsewhere. Calls
/// block. Several calls can run at once.
pub trait Network: Send + Sync {
    /// Returns its inputs and outputs, known before any call.
    fn signature(&self) -> &Signature;

    /// Computes the requested outputs, in the requested order.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the network: a failed call, or values that are not
    /// finite.
    fn run(&self, inputs: &[Input], outputs: &[&str]) -> Result<Vec<Tensor>, ModelError>;
}

/// A required shape. `None`: any size.
pub type Pattern<'a> = &'a [Option<usize>];

impl Signature {
    /// Checks that a tensor exists, with this type and a shape that matches `pattern`.
    ///
    /// # Errors
    /// Returns [`ModelError::Tensor`], which names the file and the tensor.
    pub fn expect(
        &self,
        file: &Utf8Path,
        direction: Direction,
        name: &str,
        element: Element,
        pattern: Pattern,
    ) -> Result<(), ModelError> {
        let wrong = |why: String| ModelError::Tensor {
            file: file.to_owned(),
            tensor: name.to_owned(),
            why,
        };
        let (ports, word) = match direction {
            Direction::In => (&self.inputs, "input"),
            Direction::Out => (&self.outputs, "output"),
        };
        let Some(port) = ports.iter().find(|port| port.name == name) else {
            let there: Vec<&str> = ports.iter().map(|port| port.name.as_str()).collect();
            return Err(wrong(format!(
                "no {word} has this name; the {word}s are {}",
                there.join(", ")
            )));
        };
        if port.element != element {
            return Err(wrong(format!("the {word} is {:?}, expected {element:?}", port.element)));
        }
        let allows = |(declared, wanted): (&i64, &Option<usize>)| {
            *declared < 0 || wanted.is_none_or(|w| *declared == w as i64)
        };
        if port.shape.len() != pattern.len() || !port.shape.iter().zip(pattern).all(allows) {
            return Err(wrong(format!(
                "the {word} has the shape {}, expected {}",
                format_shape(&port.shape),
                format_pattern(pattern)
            )));
        }
        Ok(())
    }
}

/// The side of a network that a tensor is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// An input of the network.
    In,
    /// An output of the network.
    Out,
}

fn format_shape(shape: &[i64]) -> String {
    let word = |d: &i64| if *d < 0 { "?".to_owned() } else { d.to_string() };
    format!("[{}]", shape.iter().map(word).collect::<Vec<_>>().join(", "))
}

fn format_pattern(pattern: Pattern) -> String {
    let word = |d: &Option<usize>| d.map_or("?".to_owned(), |d| d.to_string());
    format!("[{}]", pattern.iter().map(word).collect::<Vec<_>>().join(", "))
}

/// Refuses values that are not finite. An error is better than a wrong cosine.
///
/// # Errors
/// Returns [`ModelError::NotFinite`].
pub fn check_finite(network: &str, tensor: &str, values: &[f32]) -> Result<(), ModelError> {
    // The sum of finite values is finite, except on overflow. Only then each value is checked.
    if values.iter().map(|v| v * 0.0).sum::<f32>() == 0.0 {
        return Ok(());
    }
    Err(ModelError::NotFinite { network: network.into(), tensor: tensor.into() })
}
