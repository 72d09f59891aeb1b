/* Replaces practice.js on pages without questions. */
const Practice = { suffix: "", toAddress: () => ({}), start() {} };
