//! Encoders: how instances and words are compared. Built in: [`attributes`].

pub mod attributes;
pub mod chat;
