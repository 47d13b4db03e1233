function [u, s] = ${name}(s, t, y, r, dr, ddr, u)
${head}
    if isempty(s)${begin}
        s = zeros(1, ${state});${first}
    end${step}
    u = zeros(1, ${pumps});${results}
end${functions}
