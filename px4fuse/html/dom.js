/* Helpers for DOM nodes of all pages. Text from data becomes text nodes only, never HTML. */
"use strict";
const $ = (id) => document.getElementById(id);
const query = (selector) => document.querySelector(selector);
const queryAll = (selector) => [...document.querySelectorAll(selector)];
/* Make a node with a text and properties, or with a CSS class if `properties` is a string */
const make = (tag, text = "", properties = {}) => Object.assign(document.createElement(tag),
  { textContent: text }, typeof properties === "string" ? { className: properties } : properties);
/* Fraction of a logarithmic axis */
const axisFraction = (ratio, [low, high]) => Math.log(ratio / low) / Math.log(high / low);
const onClick = (id, act) => $(id).addEventListener("click", act);
