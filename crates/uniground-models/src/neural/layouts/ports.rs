//! Finds inputs and outputs of a network by the names that exporters give them.

use super::super::ModelError;
use super::super::network::{Element, Port};
use super::Graph;

/// Returns the first port with one of these names.
pub fn find<'a>(ports: &'a [Port], names: &[&str]) -> Option<&'a Port> {
    names.iter().find_map(|name| ports.iter().find(|port| port.name == *name))
}

/// Returns a dimension with a fixed size, counted from the end: 0 is the last one.
pub fn fixed(port: &Port, from_end: usize) -> Option<usize> {
    let dimension = port.shape.iter().rev().nth(from_end)?;
    usize::try_from(*dimension).ok().filter(|size| *size > 0)
}

fn list(ports: &[Port]) -> String {
    ports.iter().map(|port| port.name.as_str()).collect::<Vec<_>>().join(", ")
}

impl Graph {
    pub fn inputs(&self) -> &[Port] {
        &self.content.signature.inputs
    }

    pub fn outputs(&self) -> &[Port] {
        &self.content.signature.outputs
    }

    /// Returns the input with one of these names.
    ///
    /// # Errors
    /// Returns an error that lists the inputs if none has such a name, or if its values are not of
    /// this type.
    pub fn input(&self, names: &[&str], element: Element) -> Result<&Port, ModelError> {
        let port = find(self.inputs(), names).ok_or_else(|| {
            let (expected, found) = (names.join(" or "), list(self.inputs()));
            self.wrong(format!("expected an input {expected}, found {found}"))
        })?;
        self.typed(port, element)
    }

    /// Returns the output of floats with one of these names.
    ///
    /// # Errors
    /// Like [`input`](Self::input).
    pub fn output(&self, names: &[&str]) -> Result<&Port, ModelError> {
        let port = find(self.outputs(), names).ok_or_else(|| {
            let (expected, found) = (names.join(" or "), list(self.outputs()));
            self.wrong(format!("expected an output {expected}, found {found}"))
        })?;
        self.typed(port, Element::F32)
    }

    fn typed<'a>(&self, port: &'a Port, element: Element) -> Result<&'a Port, ModelError> {
        let word = match element {
            Element::F32 => "32-bit floats",
            Element::I64 => "64-bit integers",
            Element::Other => "another type",
        };
        match port.element == element {
            true => Ok(port),
            false => {
                Err(self
                    .wrong(format!("{} does not hold {word}; choose another precision", port.name)))
            }
        }
    }

    /// Refuses inputs that nothing will be fed to.
    ///
    /// # Errors
    /// Returns an error that names the first one.
    pub fn expect_only(&self, known: &[&str]) -> Result<(), ModelError> {
        match self.inputs().iter().find(|port| !known.contains(&port.name.as_str())) {
            None => Ok(()),
            Some(port) if port.name == "pixel_attention_mask" => Err(self.wrong(
                "has the input pixel_attention_mask: SigLIP 2 NaFlex is not supported; take a \
                 model of a fixed resolution",
            )),
            Some(port) if port.name == "input_points" => Err(self.wrong(
                "is one network for pictures and prompts, which would encode a picture for every \
                 prompt: export encoder and decoder separately",
            )),
            Some(port) => Err(self.wrong(format!(
                "has the input {}, which uniground does not feed; expected only {}",
                port.name,
                known.join(", ")
            ))),
        }
    }
}
