/* Replaces practice.js on pages without questions. */
const Practice = { suffix: "", hidden: false, toAddress: () => ({}), start() {} };
