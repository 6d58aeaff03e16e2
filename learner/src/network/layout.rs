//! Where each parameter lies in the one flat vector that holds them all.
//!
//! One vector makes the optimiser, the gradient norm, checkpoints and the sum over shards single operations,
//! whatever the number of layers.

use tch::Tensor;

/// Parameters start at multiples of this many floats (64 bytes), so that the alignment that the matrix
/// library sees is the same in every run, and with it the rounding.
const ALIGNMENT_FLOATS: usize = 16;

/// One parameter: its name in checkpoints, its shape, and where it starts in the flat vector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// For instance `policy.0.weight`.
    pub name: String,
    /// `[out, in]` for weights, `[out]` for biases, `[A]` for the log-std.
    pub shape: Vec<i64>,
    /// First element in the flat vector.
    pub offset: usize,
}

impl Parameter {
    /// Number of elements.
    pub fn numel(&self) -> usize {
        self.shape.iter().product::<i64>() as usize
    }
}

/// The parameters of a network, in order, and the length of the flat vector with its padding.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Layout {
    parameters: Vec<Parameter>,
    len: usize,
}

impl Layout {
    /// Appends a parameter and answers its index.
    pub fn push(&mut self, name: String, shape: &[i64]) -> usize {
        let parameter = Parameter { name, shape: shape.to_vec(), offset: self.len };
        self.len += parameter.numel().next_multiple_of(ALIGNMENT_FLOATS);
        self.parameters.push(parameter);
        self.parameters.len() - 1
    }

    /// All parameters, in order.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Length of the flat vector, floats.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True before the first parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The parameter at `index` as a view of `flat` `[len]`, sharing its memory.
    pub fn view(&self, flat: &Tensor, index: usize) -> Tensor {
        let parameter = &self.parameters[index];
        flat.narrow(0, parameter.offset as i64, parameter.numel() as i64)
            .view(parameter.shape.as_slice())
    }
}

/// Where the parameters of the networks lie in the flat vector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The policy's layers, input side first.
    pub policy: Vec<LayerPlace>,
    /// The value function's.
    pub value: Vec<LayerPlace>,
    /// First of the parameters of the log-std, `[A]`.
    pub raw_log_std: usize,
    /// P, padding included.
    pub len: usize,
}

/// One layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LayerPlace {
    /// First of its weights, `[out, in]`.
    pub weight: usize,
    /// First of its biases, `[out]`.
    pub bias: usize,
    /// Inputs.
    pub inputs: usize,
    /// Outputs.
    pub outputs: usize,
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, Kind};

    #[test]
    fn views_share_memory_and_start_at_multiples_of_sixteen_floats() {
        let mut layout = Layout::default();
        layout.push("a".into(), &[3, 2]); // 6 floats, padded to 16
        layout.push("b".into(), &[17]); // 17 floats, padded to 32
        assert_eq!(layout.parameters()[1].offset, 16);
        assert_eq!(layout.len(), 48);
        let flat = Tensor::zeros([48], (Kind::Float, Device::Cpu));
        let _ = layout.view(&flat, 1).fill_(1.0);
        assert_eq!(flat.sum(Kind::Float).double_value(&[]), 17.0);
        assert_eq!(flat.double_value(&[16]), 1.0);
    }
}
