${head}
// step changes the state s and returns u.
"use strict";
const ${name} = (() => {${helpers}

function init(y, u = [${initial}]) {${begin}
    return Float64Array.of(${first});
}

function step(s, t, y, r, dr, ddr) {${step}
}

return {init, step, ${facts}};
})();
if (typeof module === "object") module.exports = ${name};
