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
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// The policy's layers, input side first.
    pub policy: Vec<LayerPlace>,
    /// The value function's.
    pub value: Vec<LayerPlace>,
    /// First of the parameters of the log-std, `[A]`.
    pub raw_log_std: usize,
    /// A.
    pub act_dim: usize,
    /// Logarithms of the least and the greatest standard deviation.
    pub log_std_bounds: (f64, f64),
    /// Parameters of the policy, its log-std included; the value function's come behind them.
    pub policy_len: usize,
    /// P, padding included.
    pub len: usize,
}

impl Place {
    /// The log-std `[A]` of `parameters` `[P]`.
    pub fn log_std_of(&self, parameters: &[f32]) -> Vec<f32> {
        self.log_std_and_slope(&parameters[self.raw_log_std..][..self.act_dim]).0
    }

    /// The log-std `[A]` of its parameters `raw` `[A]`, and its slope with respect to them: d log_std / d raw =
    /// (log_std − lo)(hi − log_std)/(hi − lo).
    pub fn log_std_and_slope(&self, raw: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (lo, hi) = self.log_std_bounds;
        let value = |raw: &f32| lo + (hi - lo) / (1.0 + (-f64::from(*raw)).exp());
        let values = raw.iter().map(value);
        values.map(|x| (x as f32, ((x - lo) * (hi - x) / (hi - lo)) as f32)).unzip()
    }
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
