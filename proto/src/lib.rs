//! Wire formats: protobuf messages, generated code and the checked conversions to domain types.
