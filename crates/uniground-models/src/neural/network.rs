//! A network as its users see it: named tensors in, named tensors out, wherever it runs.

use super::ModelError;
use camino::Utf8Path;

/// Values going in, row-major.
#[derive(Debug, Clone, Copy)]
pub enum Values<'a> {
    /// 32-bit floats: pictures, points, features.
    F32(&'a [f32]),
    /// 64-bit integers: token ids.
    I64(&'a [i64]),
}

/// A tensor going in.
#[derive(Debug, Clone)]
pub struct Input<'a> {
    /// Name of the network's port it goes to.
    pub name: &'a str,
    /// Size of each dimension, batch first.
    pub shape: Vec<usize>,
    /// As many as the sizes in `shape` multiplied.
    pub values: Values<'a>,
}

/// A tensor that came out: 32-bit floats, row-major, all of them finite.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Size of each dimension, batch first.
    pub shape: Vec<usize>,
    /// As many as the sizes in `shape` multiplied.
    pub values: Vec<f32>,
}

/// What a tensor's values are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    F32,
    /// 64-bit integers.
    I64,
    /// Anything else: no network that is used here may need it.
    Other,
}

/// An input or output as the network declares it. A dimension of -1 is free.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Port {
    /// By which it is fed or asked for; unique on its side of the network.
    pub name: String,
    /// What its values are.
    pub element: Element,
    /// Size of each dimension, batch first.
    pub shape: Vec<i64>,
}

/// What a network takes and makes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Signature {
    /// Taken, as the network lists them.
    pub inputs: Vec<Port>,
    /// Made, as the network lists them.
    pub outputs: Vec<Port>,
}

/// Runs in this process ([`OnnxRuntime`](super::OnnxRuntime)) or elsewhere. Calls block; several
/// may run at once.
pub trait Network: Send + Sync {
    /// Its inputs and outputs, known before any call.
    fn signature(&self) -> &Signature;

    /// Computes the wanted outputs, in the order asked.
    ///
    /// # Errors
    /// [`ModelError`] naming the network: a failed call, or values that are no numbers.
    fn run(&self, inputs: &[Input], outputs: &[&str]) -> Result<Vec<Tensor>, ModelError>;
}

/// A shape as a network may declare it; `None` = any size.
pub type Pattern<'a> = &'a [Option<usize>];

impl Signature {
    /// Checks that a tensor is there, with this type and a shape that allows `pattern`.
    ///
    /// # Errors
    /// [`ModelError::Tensor`] naming the file and the tensor.
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
            return Err(wrong(format!("there is no such {word}; there are {}", there.join(", "))));
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
                spelled(&port.shape),
                spelled_pattern(pattern)
            )));
        }
        Ok(())
    }
}

/// Which side of a network a tensor is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// The network takes it.
    In,
    /// The network makes it.
    Out,
}

fn spelled(shape: &[i64]) -> String {
    let word = |d: &i64| if *d < 0 { "?".to_owned() } else { d.to_string() };
    format!("[{}]", shape.iter().map(word).collect::<Vec<_>>().join(", "))
}

fn spelled_pattern(pattern: Pattern) -> String {
    let word = |d: &Option<usize>| d.map_or("?".to_owned(), |d| d.to_string());
    format!("[{}]", pattern.iter().map(word).collect::<Vec<_>>().join(", "))
}

/// Refuses values that are no numbers: half a cosine is worse than an error.
///
/// # Errors
/// [`ModelError::NotFinite`].
pub fn finite(network: &str, tensor: &str, values: &[f32]) -> Result<(), ModelError> {
    // A sum is finite when all are, but for overflow: look closer only then.
    if values.iter().map(|v| v * 0.0).sum::<f32>() == 0.0 {
        return Ok(());
    }
    Err(ModelError::NotFinite { network: network.into(), tensor: tensor.into() })
}
